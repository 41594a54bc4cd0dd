//! `noctule weights`: what the networks are, whether one computes what it should, and the mean of two.

use std::path::{Path, PathBuf};

use noctule_erunet::{Config, Description, describe, parity};

use super::named::weights;
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
    /// The mean of two sets of weights of one network, value by value; each `xs`, `s` or a file
    #[arg(long, group = "action", num_args = 2, value_names = ["WEIGHTS", "OTHER"], requires = "out")]
    mix: Option<Vec<String>>,
    /// How much of OTHER the mean holds, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.5, conflicts_with_all = ["describe", "parity"])]
    share: f64,
    /// Where the mean goes
    #[arg(long, value_name = "FILE", conflicts_with_all = ["describe", "parity"])]
    out: Option<PathBuf>,
    /// JSON instead of text; each member's `config` describes its widths
    #[arg(long, conflicts_with = "mix")]
    json: bool,
}

/// Describes, mixes or compares.
pub fn run(arguments: &Arguments) -> Outcome {
    match (&arguments.parity, arguments.mix.as_deref(), &arguments.out) {
        (Some(dir), ..) => compare(dir, arguments.json),
        (None, Some([one, other]), Some(out)) => mix(one, other, arguments.share, out),
        _ => describe_family(arguments.json),
    }
}

fn mix(one: &str, other: &str, share: f64, out: &Path) -> Outcome {
    let mixed = weights(one)?.mixed(&weights(other)?, share);
    mixed
        .and_then(|mixed| mixed.write(out))
        .map_err(|cause| Failure::Error(format!("{one} and {other}: {cause}").into()))
}

#[expect(clippy::print_stdout, reason = "the answer is this command's output")]
fn compare(dir: &Path, json: bool) -> Outcome {
    let report = parity(dir)?;
    if json {
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
