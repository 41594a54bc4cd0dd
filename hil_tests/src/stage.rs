//! What a test stands on: a short recording, a configuration, a name of its own.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

use noctule_world::{DriveOptions, Faults, Rig, Tier, record_drive};
use tempfile::TempDir;

use crate::process::Started;
use crate::program::program;

/// Columns and rows of the rendered camera; the network's grid is half of it.
const SIZE: usize = 256;
const SEED: u64 = 5;

/// A recording with its configuration; shared by the tests of one program.
#[derive(Debug)]
pub struct Stage {
    folder: TempDir,
}

impl Stage {
    /// The stage, built on first use: 1.6 seconds of night with a few faults.
    ///
    /// # Panics
    /// When the drive cannot be rendered.
    #[must_use]
    pub fn shared() -> &'static Self {
        static STAGE: OnceLock<Stage> = OnceLock::new();
        STAGE.get_or_init(|| {
            let folder = tempfile::tempdir().unwrap();
            let options = DriveOptions {
                rig: Rig::with_size(SEED, Tier::B, SIZE),
                faults: Faults::rough(),
                ..DriveOptions::new(SEED, Tier::B, Duration::from_millis(1600))
            };
            record_drive(&options, &folder.path().join("drive"), |_| {}).unwrap();
            let grid = SIZE / 2;
            let config = format!("[grid]\nwidth = {grid}\nheight = {grid}\n");
            fs::write(folder.path().join("noctule.toml"), config).unwrap();
            Self { folder }
        })
    }

    /// The recording directory.
    #[must_use]
    pub fn drive(&self) -> PathBuf {
        self.folder.path().join("drive")
    }

    /// `noctule replay` of the recording as this instance, with a JSON report.
    #[must_use]
    pub fn replay(&self, instance: &str, arguments: &[&str]) -> Started {
        Started::new(
            Command::new(program())
                .arg("replay")
                .arg(self.drive())
                .args([
                    "--instance",
                    instance,
                    "--report",
                    "json",
                    "--model",
                    "fill",
                ])
                .arg("--config")
                .arg(self.folder.path().join("noctule.toml"))
                .args(arguments),
        )
    }
}

/// What an instance has left in shared memory and in the temporary folder.
#[must_use]
pub fn residue(instance: &str) -> Vec<PathBuf> {
    let left = |folder: &Path, prefix: &str| -> Vec<PathBuf> {
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        entries
            .filter(|e| e.file_name().to_string_lossy().starts_with(prefix))
            .map(|e| e.path())
            .collect()
    };
    let mut found = left(Path::new("/dev/shm"), &format!("noctule_{instance}_"));
    found.extend(left(&std::env::temp_dir(), &format!("noctule-{instance}")));
    found
}
