//! Reports as aligned text for a reader at a terminal.

use std::fmt::{self, Display, Formatter};

use super::{
    CanReport, ClockReport, ExposureReport, ImageReport, Inspection, LidarReport, RawReport,
    RecordingReport, Report,
};

/// Columns of the names on the left.
const NAME_LEN: usize = 12;

impl Display for Inspection {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.path.display())?;
        match &self.report {
            Report::Raw(report) => raw(report, f, "")?,
            Report::Lidar(report) => lidar(report, f, "")?,
            Report::Recording(report) => recording(report, f)?,
        }
        if !self.faults.is_empty() {
            line(f, "", "faults", &self.faults.len())?;
        }
        Ok(())
    }
}

/// One indented line with its name in a column of its own.
fn line(f: &mut Formatter<'_>, indent: &str, name: &str, value: &dyn Display) -> fmt::Result {
    writeln!(f, "{indent}  {name:<NAME_LEN$} {value}")
}

fn raw(report: &RawReport, f: &mut Formatter<'_>, indent: &str) -> fmt::Result {
    writeln!(
        f,
        "RAW {}, {}x{}",
        report.format, report.width, report.height
    )?;
    let RawReport {
        events, on, off, ..
    } = report;
    line(
        f,
        indent,
        "events",
        &format_args!("{events} ({on} on, {off} off)"),
    )?;
    if let (Some(first), Some(last)) = (report.first_us, report.last_us) {
        line(f, indent, "time", &Micros(first, last))?;
        #[expect(clippy::cast_precision_loss, reason = "shown with three decimals")]
        if let Some(us) = last.checked_sub(first).filter(|&us| us > 0) {
            let rate = *events as f64 / us as f64;
            line(f, indent, "rate", &format_args!("{rate:.3} Mev/s"))?;
        }
    }
    line(
        f,
        indent,
        "sums",
        &format_args!("x {}, y {}", report.sum_x, report.sum_y),
    )?;
    line(f, indent, "sha256", &report.events_sha256)?;
    for t in &report.triggers {
        let edges = format_args!("{} rising, {} falling", t.rising, t.falling);
        let name = format!("trigger {}", t.channel);
        let span = Micros(t.first_us, t.last_us);
        line(f, indent, &name, &format_args!("{edges}, {span}"))?;
    }
    if report.nonmonotonic > 0 {
        let value = format_args!("{} events before their predecessor", report.nonmonotonic);
        line(f, indent, "disorder", &value)?;
    }
    line(f, indent, "errors", &Counted(&report.errors))
}

fn lidar(report: &LidarReport, f: &mut Formatter<'_>, indent: &str) -> fmt::Result {
    match (report.model, report.port) {
        (Some(model), Some(port)) => writeln!(f, "LiDAR {model}, UDP port {port}")?,
        _ => writeln!(f, "LiDAR: no packet of a known sensor")?,
    }
    let (packets, lost) = (report.packets, report.lost);
    let (late, duplicate) = (report.late, report.duplicate);
    let value = format_args!("{packets} ({lost} lost, {late} late, {duplicate} duplicate)");
    line(f, indent, "packets", &value)?;
    let value = format_args!("{} ({} points)", report.returns, report.points);
    line(f, indent, "returns", &value)?;
    let value = format_args!("{} ({} complete)", report.sweeps, report.sweeps_complete);
    line(f, indent, "sweeps", &value)?;
    if let (Some(first), Some(last)) = (report.first_ns, report.last_ns) {
        line(f, indent, "time", &Nanos(first, last))?;
    }
    if report.clock_steps > 0 {
        let value = format_args!("{} ({} restarts)", report.clock_steps, report.restarts);
        line(f, indent, "clock steps", &value)?;
    }
    line(f, indent, "rejected", &Counted(&report.rejected))?;
    let skipped = report.skipped;
    let skipped = [
        ("other_port", skipped.other_port),
        ("not_udp", skipped.not_udp),
        ("fragments", skipped.fragments),
        ("cut", skipped.cut),
    ];
    line(f, indent, "skipped", &Counted(&skipped))
}

fn recording(report: &RecordingReport, f: &mut Formatter<'_>) -> fmt::Result {
    writeln!(f, "recording {:?}, schema {}", report.name, report.schema)?;
    if let Some(g) = &report.generator {
        let value = format_args!("{} {}, seed {}", g.name, g.version, g.seed);
        line(f, "", "generator", &value)?;
    }
    if let Some(events) = &report.events {
        write!(f, "  {:<NAME_LEN$} ", "events")?;
        raw(events, f, "  ")?;
    }
    if let Some(t) = &report.transfers {
        line(
            f,
            "",
            "transfers",
            &format_args!("{} ({} bytes)", t.count, t.bytes),
        )?;
    }
    if let Some(returns) = &report.lidar {
        write!(f, "  {:<NAME_LEN$} ", "lidar")?;
        lidar(returns, f, "  ")?;
    }
    if let Some(images) = &report.images {
        line(f, "", "images", &Images(images))?;
    }
    exposures(&report.exposures, f)?;
    if let Some(can) = &report.can {
        line(f, "", "can", &Can(can))?;
    }
    if let Some(clocks) = &report.clocks {
        line(f, "", "clocks", &Clocks(clocks))?;
    }
    line(f, "", "samples", &report.samples)?;
    let missing = report.missing.join(", ");
    let missing = if missing.is_empty() {
        "nothing"
    } else {
        &missing
    };
    line(f, "", "missing", &missing)
}

fn exposures(report: &ExposureReport, f: &mut Formatter<'_>) -> fmt::Result {
    let ExposureReport {
        pulses,
        unpaired_edges,
        ..
    } = report;
    let Some(channel) = report.strobe_channel else {
        return line(f, "", "exposures", &"no strobe");
    };
    let strobe = format!("{pulses} on trigger {channel}, {unpaired_edges} edges unpaired");
    match (report.width_us_min, report.width_us_max) {
        (Some(min), Some(max)) => {
            line(
                f,
                "",
                "exposures",
                &format_args!("{strobe}, {min} to {max} us"),
            )?;
        }
        _ => line(f, "", "exposures", &strobe)?,
    }
    if let Some(t) = &report.truth {
        let value = format_args!(
            "{} exposures, {} images dropped, {} edges missed, {} doubled",
            t.exposures, t.images_dropped, t.edges_missed, t.edges_doubled
        );
        line(f, "", "truth", &value)?;
    }
    Ok(())
}

/// A span of the event camera's clock.
struct Micros(u64, u64);

impl Display for Micros {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let at = |us: u64| format!("{}.{:06}", us / 1_000_000, us % 1_000_000);
        write!(f, "{} to {} s", at(self.0), at(self.1))
    }
}

/// A span of a clock that counts nanoseconds.
struct Nanos(u64, u64);

impl Display for Nanos {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let at = |ns: u64| format!("{}.{:09}", ns / 1_000_000_000, ns % 1_000_000_000);
        write!(f, "{} to {} s", at(self.0), at(self.1))
    }
}

/// The counts that are not zero.
struct Counted<'a>(&'a [(&'static str, u64)]);

impl Display for Counted<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let mut separator = "";
        for (name, count) in self.0.iter().filter(|(_, count)| *count > 0) {
            write!(f, "{separator}{name} {count}")?;
            separator = ", ";
        }
        if separator.is_empty() {
            f.write_str("none")
        } else {
            Ok(())
        }
    }
}

struct Images<'a>(&'a ImageReport);

impl Display for Images<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let i = self.0;
        write!(f, "{} of {}x{}", i.count, i.width, i.height)?;
        write!(
            f,
            " ({} lost, {} late, {} duplicate)",
            i.lost, i.late, i.duplicate
        )?;
        match (i.first_ns, i.last_ns) {
            (Some(first), Some(last)) => write!(f, ", {}", Nanos(first, last)),
            _ => Ok(()),
        }
    }
}

struct Can<'a>(&'a CanReport);

impl Display for Can<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let c = self.0;
        let kinds = [
            ("unknown", c.unknown),
            ("short", c.short),
            ("remote", c.remote),
            ("errors", c.errors),
            ("unpaired", c.unpaired),
        ];
        write!(
            f,
            "{} frames, {} of motion; others: {}",
            c.frames,
            c.motion,
            Counted(&kinds)
        )
    }
}

struct Clocks<'a>(&'a ClockReport);

impl Display for Clocks<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let c = self.0;
        let (readings, phc, tai) = (c.readings, c.phc_readings, c.tai_offset_s);
        write!(f, "{readings} readings ({phc} with PHC), TAI - UTC {tai} s")
    }
}
