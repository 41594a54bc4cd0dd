//! `noctule weights`: what the networks are, and whether one computes what it should.

use std::path::PathBuf;

use noctule_erunet::{Config, Description, describe, parity};

use super::{Failure, Outcome};

/// Arguments of `noctule weights`.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("action").required(true)))]
#[group(skip)]
pub struct Arguments {
    /// Parameters and multiply-adds of every member of the family
    #[arg(long, group = "action")]
    describe: bool,
    /// Runs the network of a fixture folder (weights, inputs, outputs, meta.json) and compares
    #[arg(long, group = "action", value_name = "DIR")]
    parity: Option<PathBuf>,
    /// JSON instead of text; each member's `config` describes its widths
    #[arg(long)]
    json: bool,
}

/// Describes or compares.
#[expect(clippy::print_stdout, reason = "the answer is this command's output")]
pub fn run(arguments: &Arguments) -> Outcome {
    let Some(dir) = &arguments.parity else {
        return describe_family(arguments.json);
    };
    let report = parity(dir)?;
    if arguments.json {
        let rows: Vec<_> = report
            .tensors
            .iter()
            .map(|t| {
                serde_json::json!({
                    "tensor": t.name,
                    "max_abs_err": t.error_max,
                    "share_of_gate": t.gate_share_max,
                    "max_abs": t.magnitude_max,
                    "within": t.is_within(),
                })
            })
            .collect();
        println!(
            "{}",
            serde_json::json!({ "within": report.is_within(), "tensors": rows })
        );
    } else {
        print!("{report}");
    }
    if report.is_within() {
        return Ok(());
    }
    eprintln!("{}: some tensors lie outside their gates", dir.display());
    Err(Failure::Gate)
}

#[expect(clippy::print_stdout, reason = "the answer is this command's output")]
fn describe_family(json: bool) -> Outcome {
    let family = [Config::full(), Config::s(), Config::xs(), Config::tiny()];
    let described: Vec<Description> = family
        .iter()
        .map(|config| describe(config, 256, 256))
        .collect::<Result<_, _>>()?;
    if json {
        println!("{}", serde_json::to_string_pretty(&described)?);
        return Ok(());
    }
    for member in &described {
        println!(
            "{}: {} parameters, {:.2} GMAC for {} steps at {}x{}",
            member.config.name,
            member.params,
            member.gmac,
            member.config.steps,
            member.size[1],
            member.size[0],
        );
        for module in &member.modules {
            println!(
                "  {:<20} {:>10} parameters {:>9.3} GMAC",
                module.name, module.params, module.gmac
            );
        }
    }
    Ok(())
}
