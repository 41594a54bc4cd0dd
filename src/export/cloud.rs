//! Returns as a PCD cloud or as rows of text.

use std::io::Write;
use std::path::Path;

use noctule_sensor::Return;

use super::events::decimal;
use super::output::Output;
use super::{ExportError, Target};

/// First line of a LiDAR CSV: metres in the LiDAR's frame, reflectivity as the sensor reports it,
/// laser (0 first), block in its packet, nanoseconds of the LiDAR's clock.
///
/// Coordinates are written with the digits that give back the same `f32`.
pub const CLOUD_COLUMNS: &str = "x,y,z,intensity,ring,block,t_ns";

/// Bytes of one point of a PCD: x, y, z, intensity f32, ring, block u16, t_ns u64, little-endian.
pub const PCD_RECORD_LEN: usize = 28;

/// Bytes of a PCD header, filled up with a comment.
const PCD_HEADER_LEN: usize = 512;

/// A cloud being written.
pub(super) struct Cloud {
    output: Output,
    target: Target,
    written: u64,
    text: Vec<u8>,
}

impl Cloud {
    pub(super) fn create(path: &Path, target: Target) -> Result<Self, ExportError> {
        let mut output = Output::create(path)?;
        match target {
            Target::Pcd => output.put(&pcd_header(0)),
            _ => output.put(format!("{CLOUD_COLUMNS}\n").as_bytes()),
        }
        Ok(Self {
            output,
            target,
            written: 0,
            text: Vec::new(),
        })
    }

    pub(super) const fn written(&self) -> u64 {
        self.written
    }

    pub(super) const fn has_failed(&self) -> bool {
        self.output.has_failed()
    }

    pub(super) fn put(&mut self, r: &Return) {
        self.written += 1;
        if self.target == Target::Pcd {
            self.output.put(&pcd_record(r));
            return;
        }
        let text = &mut self.text;
        text.clear();
        for metres in [r.x_m, r.y_m, r.z_m] {
            // Writing to memory cannot fail.
            let _written = write!(text, "{metres},");
        }
        for small in [r.intensity, r.channel, r.block] {
            decimal(u64::from(small), text);
            text.push(b',');
        }
        decimal(r.t.as_nanos(), text);
        text.push(b'\n');
        self.output.put(text);
    }

    pub(super) fn finish(mut self) -> Result<(), ExportError> {
        if self.target == Target::Pcd {
            self.output.replace_header(&pcd_header(self.written));
        }
        self.output.finish()
    }
}

fn pcd_record(r: &Return) -> [u8; PCD_RECORD_LEN] {
    let mut record = [0; PCD_RECORD_LEN];
    let floats = [r.x_m, r.y_m, r.z_m, f32::from(r.intensity)];
    for (bytes, float) in record.chunks_exact_mut(4).zip(floats) {
        bytes.copy_from_slice(&float.to_le_bytes());
    }
    record[16..18].copy_from_slice(&u16::from(r.channel).to_le_bytes());
    record[18..20].copy_from_slice(&u16::from(r.block).to_le_bytes());
    record[20..28].copy_from_slice(&r.t.as_nanos().to_le_bytes());
    record
}

/// The header of a PCD file, version 0.7 (Point Cloud Library, "The PCD file format"), unorganised
/// and binary. A comment fills it up, so that the count can be written at the end.
fn pcd_header(points: u64) -> [u8; PCD_HEADER_LEN] {
    let before = "# .PCD v0.7 - Point Cloud Data file format\n";
    let after = format!(
        "VERSION 0.7\nFIELDS x y z intensity ring block t_ns\nSIZE 4 4 4 4 2 2 8\n\
         TYPE F F F F U U U\nCOUNT 1 1 1 1 1 1 1\nWIDTH {points}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary\n"
    );
    let mut header = [b' '; PCD_HEADER_LEN];
    let (start, end) = (before.len(), PCD_HEADER_LEN - after.len());
    header[..start].copy_from_slice(before.as_bytes());
    header[start] = b'#';
    header[end - 1] = b'\n';
    header[end..].copy_from_slice(after.as_bytes());
    header
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_count_fits_the_header_between_comments() {
        for points in [0, 34_158, u64::MAX] {
            let header = String::from_utf8(pcd_header(points).to_vec()).expect("text");
            let lines: Vec<_> = header.lines().filter(|l| !l.starts_with('#')).collect();
            assert_eq!(lines.len(), 10, "{header}");
            assert_eq!(lines[5], format!("WIDTH {points}"));
            assert_eq!(lines[8], format!("POINTS {points}"));
            assert!(header.ends_with("\nDATA binary\n"));
        }
    }
}
