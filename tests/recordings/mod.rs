//! Recordings to replay: a rendered drive, and copies of it with something missing or broken.
#![allow(
    dead_code,
    clippy::unwrap_used,
    reason = "a test may stop where it stands, and each program uses its own part"
)]

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Duration;

use noctule_recording::{Calibration, EdgeTruth};
use noctule_world::{DriveOptions, Faults, Rig, Tier, TimedExposure, Timeline, record_drive};
use serde_json::Value;
use sha2::{Digest, Sha256};
use tempfile::TempDir;

/// Columns and rows of the rendered camera.
const SIZE: usize = 256;
/// Columns and rows of the network's grid.
pub const GRID: u32 = 128;
/// Long enough for five exposures.
const LENGTH: Duration = Duration::from_millis(1200);
const CLEAN_SEED: u64 = 11;

/// The first night on which a closing edge and packets are missing within that time.
fn rough_seed() -> u64 {
    let is_rough = |&seed: &u64| {
        let rig = Rig::with_size(seed, Tier::B, SIZE);
        let seconds = LENGTH.as_secs_f64();
        let of = |faults| Timeline::simulate(&rig, &faults, seed, seconds);
        let (rough, whole) = (of(Faults::rough()), of(Faults::default()));
        let missed = |e: &TimedExposure| e.truth.close_edge == EdgeTruth::Missed;
        rough.exposures.iter().any(missed) && rough.packets.len() < whole.packets.len()
    };
    (1..1000).find(is_rough).unwrap()
}

fn render(seed: u64, faults: Faults) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let rig = Rig::with_size(seed, Tier::B, SIZE);
    let options = DriveOptions {
        rig,
        faults,
        ..DriveOptions::new(seed, Tier::B, LENGTH)
    };
    record_drive(&options, dir.path(), |_| {}).unwrap();
    dir
}

/// A drive on which packets, edges and images go missing.
pub fn rough() -> &'static Path {
    static DRIVE: OnceLock<TempDir> = OnceLock::new();
    DRIVE
        .get_or_init(|| render(rough_seed(), Faults::rough()))
        .path()
}

/// A drive without faults.
pub fn clean() -> &'static Path {
    static DRIVE: OnceLock<TempDir> = OnceLock::new();
    DRIVE
        .get_or_init(|| render(CLEAN_SEED, Faults::default()))
        .path()
}

/// A copy to break, without the truth.
pub fn copy_of(drive: &Path) -> TempDir {
    let copy = tempfile::tempdir().unwrap();
    for name in ["meta.json", "calib.toml"] {
        fs::copy(drive.join(name), copy.path().join(name)).unwrap();
    }
    copy_folder(&drive.join("raw"), &copy.path().join("raw"));
    copy
}

fn copy_folder(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            copy_folder(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// Rewrites `meta.json`.
pub fn edit_meta(drive: &Path, edit: impl FnOnce(&mut Value)) {
    let path = drive.join("meta.json");
    let mut meta = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    edit(&mut meta);
    fs::write(&path, serde_json::to_vec(&meta).unwrap()).unwrap();
}

/// A copy whose rig stands `metres` higher above the ground, and nothing else.
pub fn raised_by(metres: f64, drive: &Path) -> TempDir {
    let copy = copy_of(drive);
    let path = copy.path().join("calib.toml");
    let text = fs::read_to_string(&path).unwrap();
    let mut rig = Calibration::parse(&text, &path).unwrap();
    rig.vehicle_from_lidar.translation_m[2] += metres;
    let text = rig.to_toml();
    let hash = Sha256::digest(&text);
    let hash: String = hash.iter().map(|byte| format!("{byte:02x}")).collect();
    fs::write(&path, text).unwrap();
    edit_meta(copy.path(), |meta| meta["calibration_sha256"] = hash.into());
    copy
}

/// A copy whose meta does not describe `sensor`, as if it had never been there.
pub fn without(drive: &Path, sensor: &str) -> TempDir {
    let copy = copy_of(drive);
    edit_meta(copy.path(), |meta| {
        meta["recording"]
            .as_object_mut()
            .unwrap()
            .remove(sensor)
            .unwrap();
    });
    copy
}

/// Cuts the end of a file off; `keep` tells how much stays of its length.
pub fn cut(path: &Path, keep: impl FnOnce(u64) -> u64) {
    let file = fs::OpenOptions::new().write(true).open(path).unwrap();
    let len = file.metadata().unwrap().len();
    file.set_len(keep(len)).unwrap();
}

/// Changes one bit in the middle of the event transfer that arrived next after `arrival_ns`.
pub fn flip_event_bit(drive: &Path, arrival_ns: u64) {
    let table = fs::read_to_string(drive.join("raw/events.csv")).unwrap();
    let row = |line: &str| -> [u64; 3] {
        let fields: Vec<u64> = line.split(',').map(|f| f.parse().unwrap()).collect();
        fields.try_into().unwrap()
    };
    let [offset, length, _] = table
        .lines()
        .skip(1)
        .map(row)
        .find(|&[_, length, arrival]| arrival > arrival_ns && length > 64)
        .unwrap();
    // The low byte of a 16-bit word: an address, a time or a vector of events, 16 units away.
    let at = usize::try_from(offset + length / 4 * 2).unwrap();
    let path = drive.join("raw/events.raw");
    let mut bytes = fs::read(&path).unwrap();
    bytes[at] ^= 0x10;
    fs::write(&path, bytes).unwrap();
}

/// Takes the `index`th record out of the LiDAR capture.
pub fn drop_datagram(drive: &Path, index: usize) {
    const FILE_HEADER: usize = 24;
    const RECORD_HEADER: usize = 16;
    let path = drive.join("raw/lidar.pcap");
    let mut bytes = fs::read(&path).unwrap();
    let record_len = |bytes: &[u8], at: usize| {
        let captured = bytes[at + 8..at + 12].try_into().unwrap();
        RECORD_HEADER + u32::from_le_bytes(captured) as usize
    };
    let mut at = FILE_HEADER;
    for _ in 0..index {
        at += record_len(&bytes, at);
    }
    let len = record_len(&bytes, at);
    bytes.drain(at..at + len);
    fs::write(&path, bytes).unwrap();
}

/// A real capture where there are some; otherwise the same kind of file from the rendered drive.
pub fn lone_file(real: &str, rendered: &str) -> (PathBuf, Option<TempDir>) {
    if let Some(data) = std::env::var_os("NOCTULE_DATA") {
        return (PathBuf::from(data).join(real), None);
    }
    eprintln!("NOCTULE_DATA is not set: {real} is skipped, a rendered {rendered} takes its place");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(Path::new(rendered).file_name().unwrap());
    fs::copy(rough().join(rendered), &path).unwrap();
    (path, Some(folder))
}
