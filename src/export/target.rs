//! What is to be written, by the target's name.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use super::ExportError;

/// A format that can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// `.csv`: events or returns, a header line and one row each.
    Csv,
    /// `.npy`: events, one structured array.
    Npy,
    /// `.pcd`: returns, binary.
    Pcd,
    /// `.png`: one depth map.
    Png,
    /// A folder of PNG files: depth maps.
    Folder,
}

impl Target {
    /// The format that a path asks for.
    ///
    /// # Errors
    /// Names the formats there are, when the path asks for another.
    pub fn of(path: &Path) -> Result<Self, ExportError> {
        let name = path.as_os_str().to_string_lossy();
        if path.is_dir() || name.ends_with('/') {
            return Ok(Self::Folder);
        }
        let Some(extension) = path.extension() else {
            return Ok(Self::Folder);
        };
        match extension.to_string_lossy().to_ascii_lowercase().as_str() {
            "csv" => Ok(Self::Csv),
            "npy" => Ok(Self::Npy),
            "pcd" => Ok(Self::Pcd),
            "png" => Ok(Self::Png),
            _ => Err(ExportError::Extension {
                path: path.to_owned(),
            }),
        }
    }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Csv => "csv",
            Self::Npy => "npy",
            Self::Pcd => "pcd",
            Self::Png => "png",
            Self::Folder => "a folder",
        })
    }
}

/// What can be exported.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stream {
    /// Events of the event camera: to CSV and NPY.
    Events,
    /// Returns of the LiDAR: to PCD and CSV.
    Lidar,
    /// Depth maps: to PNG.
    Depth,
}

impl fmt::Display for Stream {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Events => "events",
            Self::Lidar => "lidar",
            Self::Depth => "depth",
        })
    }
}

impl FromStr for Stream {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        [Self::Events, Self::Lidar, Self::Depth]
            .into_iter()
            .find(|stream| stream.to_string() == name)
            .ok_or_else(|| format!("needs events, lidar or depth, not {name:?}"))
    }
}
