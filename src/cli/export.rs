//! `noctule export`: files for other programs.

use std::path::PathBuf;

use noctule::export::{self, DepthFormat, DepthOptions, Layer, LidarOptions, Request, Stream};
use noctule::inspect::bytes_to_read;
use noctule_evk4::Geometry;
use noctule_hesai::Returns;

use super::inspect::geometry;
use super::{Outcome, progress};

const DETAILS: &str = "\
Formats, by the extension of --to:
  events  .csv  t_us,x,y,p
          .npy  structured array: t u64 (us), x u16, y u16, p u8
  lidar   .csv  x,y,z,intensity,ring,block,t_ns
          .pcd  version 0.7, binary: x y z intensity (f32), ring block (u16), t_ns (u64)
  depth   .png  one map; a folder (no extension) takes all maps of a folder or recording
A damaged source is exported as far as it goes; what is wrong and where is said on standard error.
Exit codes: 0 written, at least in part; 1 nothing was written; 2 wrong arguments.";

/// Arguments of `noctule export`.
#[derive(Debug, clap::Args)]
#[command(after_help = DETAILS)]
pub struct Arguments {
    /// RAW file, pcap or pcapng capture, recording directory, depth PNG (16 bits) or folder of them
    #[arg(value_name = "FILE")]
    from: PathBuf,
    /// File to write, replaced if it exists; its extension decides the format
    #[arg(long, value_name = "PATH")]
    to: PathBuf,
    /// Stream of a recording: events, lidar or depth
    #[arg(long)]
    stream: Option<Stream>,
    /// The LiDAR's own angle table, instead of a recording's or the model's
    #[arg(long, value_name = "CSV")]
    angles: Option<PathBuf>,
    /// The LiDAR's own fire-time table, instead of the model's
    #[arg(long, value_name = "CSV")]
    fire_times: Option<PathBuf>,
    /// all: every return; unique: equal returns of one firing once
    #[arg(long, default_value = "unique", value_parser = returns, value_name = "all|unique")]
    returns: Returns,
    /// Only this LiDAR sweep; the first is 0
    #[arg(long, value_name = "N")]
    sweep: Option<u32>,
    /// Depth of a recording as the LiDAR saw it, instead of the truth
    #[arg(long)]
    sparse: bool,
    /// Depth as 16-bit PNG (metres times 256), instead of colours
    #[arg(long)]
    png16: bool,
    /// Depth of the lightest colour, metres
    #[arg(long, default_value_t = DepthOptions::default().near_m, value_name = "M")]
    near: f32,
    /// Depth of the darkest colour, metres
    #[arg(long, default_value_t = DepthOptions::default().far_m, value_name = "M")]
    far: f32,
    /// Size of the event sensor where a RAW header gives none
    #[arg(long, value_name = "WxH", value_parser = geometry)]
    geometry: Option<Geometry>,
}

/// Exports, and says how much.
#[expect(clippy::print_stdout, reason = "the answer is this command's output")]
pub fn run(arguments: &Arguments) -> Outcome {
    let bar = progress::bar(bytes_to_read(&arguments.from), "exporting");
    let exported = export::export(&request(arguments), &|len| bar.inc(len));
    bar.finish_and_clear();
    let exported = exported?;
    println!(
        "{}: {} {}",
        arguments.to.display(),
        exported.written,
        exported.unit
    );
    let from = arguments.from.display();
    for (kind, count) in &exported.undecoded {
        eprintln!("warning: {from}: not decoded: {kind} {count}");
    }
    for fault in &exported.faults {
        eprintln!("warning: {fault}");
    }
    Ok(())
}

fn request(arguments: &Arguments) -> Request {
    Request {
        from: arguments.from.clone(),
        to: arguments.to.clone(),
        stream: arguments.stream,
        geometry: arguments.geometry,
        lidar: LidarOptions {
            angles: arguments.angles.clone(),
            fire_times: arguments.fire_times.clone(),
            returns: arguments.returns,
            sweep: arguments.sweep,
        },
        depth: DepthOptions {
            format: if arguments.png16 {
                DepthFormat::Png16
            } else {
                DepthFormat::Colour
            },
            layer: if arguments.sparse {
                Layer::Sparse
            } else {
                Layer::Truth
            },
            near_m: arguments.near,
            far_m: arguments.far,
        },
    }
}

fn returns(name: &str) -> Result<Returns, String> {
    match name {
        "all" => Ok(Returns::All),
        "unique" => Ok(Returns::Unique),
        _ => Err(format!("needs all or unique, not {name:?}")),
    }
}
