//! `noctule inspect`: what is in RAW files, packet captures and recordings.

use std::path::PathBuf;

use noctule::inspect::{self, Inspection, Options};
use noctule_evk4::Geometry;

use super::{Failure, Outcome, progress};

const DETAILS: &str = "\
Files are told apart by their first bytes. With --json each file is one line, one object.
A damaged file is reported as far as it goes; what is wrong and where is said on standard error and
listed under `faults`.
Exit codes: 0 every file could be read, at least in part; 1 of at least one file nothing could be
read (the others are reported all the same); 2 wrong arguments.";

/// Arguments of `noctule inspect`.
#[derive(Debug, clap::Args)]
#[command(after_help = DETAILS)]
pub struct Arguments {
    /// RAW files, pcap and pcapng captures, recording directories
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// One JSON object per file and line
    #[arg(long)]
    json: bool,
    /// The LiDAR's own angle table, instead of a recording's or the model's
    #[arg(long, value_name = "CSV")]
    angles: Option<PathBuf>,
    /// Size of the event sensor where a RAW header gives none
    #[arg(long, value_name = "WxH", value_parser = geometry)]
    geometry: Option<Geometry>,
}

/// Inspects each file; one that cannot be read does not stop the others.
pub fn run(arguments: &Arguments) -> Outcome {
    let options = Options {
        angles: arguments.angles.clone(),
        geometry: arguments.geometry,
    };
    let mut unreadable = false;
    for path in &arguments.files {
        let bar = progress::bar(inspect::bytes_to_read(path), "reading");
        let inspected = inspect::inspect(path, &options, &|len| bar.inc(len));
        bar.finish_and_clear();
        match inspected {
            Ok(inspection) => show(&inspection, arguments.json)?,
            Err(error) => {
                eprintln!("error: {error}");
                unreadable = true;
            }
        }
    }
    if unreadable {
        Err(Failure::Gate)
    } else {
        Ok(())
    }
}

#[expect(clippy::print_stdout, reason = "the answer is this command's output")]
fn show(inspection: &Inspection, json: bool) -> Outcome {
    if json {
        println!("{}", serde_json::to_string(inspection)?);
    } else {
        print!("{inspection}");
    }
    for fault in &inspection.faults {
        eprintln!("warning: {fault}");
    }
    Ok(())
}

/// Two numbers of pixels, as in `1280x720`.
pub(super) fn geometry(text: &str) -> Result<Geometry, String> {
    let side = |side: &str| side.parse::<u16>().ok().filter(|&side| side > 0);
    let sides = text
        .split_once('x')
        .and_then(|(w, h)| Some((side(w)?, side(h)?)));
    let (width, height) = sides
        .ok_or_else(|| format!("needs WIDTHxHEIGHT in pixels, such as 1280x720, not {text:?}"))?;
    Ok(Geometry { width, height })
}
