//! One running Noctule on a machine: a name, and the files that belong to it.

use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use iceoryx2::prelude::{Config, FileName, SemanticString};

use super::BusError;

const SHARED_MEMORY: &str = "/dev/shm";

/// The name of an instance; two of different names share nothing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InstanceName(String);

impl FromStr for InstanceName {
    type Err = BusError;

    fn from_str(text: &str) -> Result<Self, BusError> {
        let ok = (1..=32).contains(&text.len())
            && text
                .bytes()
                .all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
        if ok {
            Ok(Self(text.to_owned()))
        } else {
            Err(BusError::Name(text.to_owned()))
        }
    }
}

impl std::fmt::Display for InstanceName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

/// Where an instance keeps its files.
#[derive(Debug, Clone)]
pub struct Instance {
    name: InstanceName,
    prefix: String,
    root: PathBuf,
}

impl Instance {
    /// The instance of this name; touches nothing.
    #[must_use]
    pub fn new(name: InstanceName) -> Self {
        let prefix = format!("noctule_{name}_");
        let root = std::env::temp_dir().join(format!("noctule-{name}"));
        Self { name, prefix, root }
    }

    /// Its name.
    #[must_use]
    pub fn name(&self) -> &InstanceName {
        &self.name
    }

    /// The folder of its bookkeeping files.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    pub(super) fn config(&self) -> Result<Config, BusError> {
        let refused = |_| BusError::Name(self.name.to_string());
        let mut config = Config::default();
        config.global.prefix = FileName::new(self.prefix.as_bytes()).map_err(refused)?;
        let root = self.root.to_string_lossy();
        let root = iceoryx2::prelude::Path::new(root.as_bytes()).map_err(refused)?;
        config.global.set_root_path(&root);
        Ok(config)
    }

    /// Everything of this instance that is on disk or in shared memory now.
    #[must_use]
    pub fn residue(&self) -> Vec<PathBuf> {
        let mut found: Vec<PathBuf> = fs::read_dir(SHARED_MEMORY)
            .into_iter()
            .flatten()
            .flatten()
            .filter(|e| e.file_name().to_string_lossy().starts_with(&self.prefix))
            .map(|e| e.path())
            .collect();
        if self.root.exists() {
            found.push(self.root.clone());
        }
        found
    }

    /// Removes the residue; only for when no process of the instance is alive.
    pub(super) fn sweep(&self) {
        for path in self.residue() {
            let removed = if path.is_dir() {
                fs::remove_dir_all(&path)
            } else {
                fs::remove_file(&path)
            };
            if let Err(error) = removed {
                tracing::warn!("{}: not removed: {error}", path.display());
            }
        }
    }

    /// Refuses to start when shared memory has no room: a full one kills its writer with SIGBUS.
    pub(super) fn require_room(needed: u64) -> Result<(), BusError> {
        let free = free_bytes(Path::new(SHARED_MEMORY));
        match free {
            Some(free) if free < needed => Err(BusError::Room {
                path: SHARED_MEMORY,
                free_mib: free >> 20,
                needed_mib: needed.div_ceil(1 << 20),
            }),
            _ => Ok(()),
        }
    }
}

fn free_bytes(path: &Path) -> Option<u64> {
    let stat = rustix::fs::statvfs(path).ok()?;
    Some(stat.f_frsize.saturating_mul(stat.f_bavail))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_could_leave_their_folder_are_refused() {
        for bad in ["", "a/b", "..", "a b", "ü", &"x".repeat(33)] {
            assert!(bad.parse::<InstanceName>().is_err(), "{bad}");
        }
        assert!("rig-2_a".parse::<InstanceName>().is_ok());
    }

    #[test]
    fn shared_memory_room_is_checked() {
        assert!(Instance::require_room(1 << 20).is_ok());
        assert!(matches!(
            Instance::require_room(u64::MAX),
            Err(BusError::Room { .. })
        ));
    }
}
