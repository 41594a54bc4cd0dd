//! The program's configuration: TOML in, validated structs out.
//!
//! The whole file is checked before anything starts: unknown keys, values out of range and budgets
//! that contradict each other are refused with the key's name. Every budget has its one home here.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use noctule_can::MotionConfig;
use serde::Deserialize;

use crate::bus::{Instance, InstanceName, Limits};
use crate::frame::{BundleLayout, DepthLayout, ModelId};

/// The configuration that ships with the program, every key at its default.
pub const DEFAULT_TOML: &str = include_str!("../config/noctule.toml");

/// Why a configuration is refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{path}: {cause}")]
    Read {
        /// Which file.
        path: PathBuf,
        /// Why.
        cause: std::io::Error,
    },
    /// Not TOML, an unknown key, or a value of the wrong type; the cause names line and column.
    #[error("{origin}: {cause}")]
    Syntax {
        /// Where the text came from.
        origin: String,
        /// What is wrong where.
        cause: Box<toml::de::Error>,
    },
    /// A value that no rig can run with.
    #[error("{origin}: {key} = {value}: {reason}")]
    Value {
        /// Where the text came from.
        origin: String,
        /// The key, dotted.
        key: &'static str,
        /// Its value.
        value: String,
        /// What is allowed.
        reason: String,
    },
}

/// Refuses a key's value for a reason.
type Refuse<'a> = dyn Fn(&'static str, &dyn ToString, &str) -> Result<(), ConfigError> + 'a;

/// The whole configuration.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Name of this running Noctule.
    pub instance: String,
    /// The network's view of an exposure.
    pub grid: Grid,
    /// The camera's exposure strobe.
    pub strobe: Strobe,
    /// Budgets from the shutter's closing.
    pub budget: Budget,
    /// Blocks between the threads.
    pub lanes: Lanes,
    /// The LiDAR.
    pub lidar: Lidar,
    /// The inference process.
    pub infer: Infer,
    /// Signals of the vehicle's motion.
    pub can: MotionConfig,
}

/// See `config/noctule.toml`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Grid {
    /// Columns W.
    pub width: u32,
    /// Rows H.
    pub height: u32,
    /// Steps T.
    pub steps: u32,
    /// Voxel bins per step B.
    pub bins: u32,
    /// Largest depth, metres.
    pub depth_m_max: f32,
}

/// Level of the strobe line while the shutter is open.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Active {
    /// Rising edge opens.
    High,
    /// Falling edge opens.
    Low,
}

/// See `config/noctule.toml`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Strobe {
    /// Trigger input.
    pub channel: u8,
    /// Polarity.
    pub active: Active,
    /// Shutter to opening edge, microseconds.
    pub open_delay_us: i32,
    /// Shutter to closing edge, microseconds.
    pub close_delay_us: i32,
    /// Period of made-up exposures, milliseconds.
    pub virtual_period_ms: u32,
    /// Width of made-up exposures, milliseconds.
    pub virtual_width_ms: u32,
}

/// See `config/noctule.toml`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Budget {
    /// Closing to bundle sent, milliseconds.
    pub bundle_ms: u32,
    /// Closing to last depth map, milliseconds.
    pub depth_ms: u32,
}

impl Budget {
    /// Closing to bundle sent.
    #[must_use]
    pub fn bundle(&self) -> Duration {
        Duration::from_millis(self.bundle_ms.into())
    }

    /// Closing to last depth map.
    #[must_use]
    pub fn depth(&self) -> Duration {
        Duration::from_millis(self.depth_ms.into())
    }
}

/// See `config/noctule.toml`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Lanes {
    /// Blocks of events.
    pub event_blocks: usize,
    /// LiDAR packets.
    pub lidar_packets: usize,
    /// Camera images.
    pub images: usize,
    /// Motion samples.
    pub motion: usize,
    /// Events kept for rastering again; a power of two.
    pub history_events: usize,
}

/// See `config/noctule.toml`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Lidar {
    /// Model name, or "auto".
    pub model: String,
    /// UDP port.
    pub port: u16,
    /// Angle correction table of this unit; without it the nominal one.
    pub angles: Option<PathBuf>,
    /// Firing time table; without it the nominal one.
    pub fire_times: Option<PathBuf>,
}

/// See `config/noctule.toml`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Infer {
    /// The model to run when there is time.
    pub model: ModelId,
    /// Whether cheaper ones may stand in.
    pub ladder: bool,
    /// Threads that work on a network together; 0 is one per processor, at most
    /// [`THREADS_DEFAULT_MAX`].
    pub threads: usize,
    /// How a network stores features and weights on processors.
    pub precision: Precision,
    /// Where networks run.
    pub device: Device,
    /// Weight files by model.
    pub weights: BTreeMap<ModelId, PathBuf>,
}

/// Most threads a network takes where the configuration leaves the number open.
pub const THREADS_DEFAULT_MAX: usize = 4;
/// Most threads a configuration may ask for.
pub const THREADS_MAX: usize = 64;

/// The networks whose weights are part of the program, cheapest first.
pub const SHIPPED: &[ModelId] = if cfg!(feature = "model") {
    &[ModelId::Xs, ModelId::S]
} else {
    &[]
};

/// How numbers are stored; sums are always single precision.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// bfloat16 where the processor multiplies it, else single precision.
    Auto,
    /// Single precision.
    F32,
    /// bfloat16.
    Bf16,
}

/// Where networks run: `cpu` or `cuda:0`, `cuda:1`, ...
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub enum Device {
    /// The processors.
    Cpu,
    /// A GPU, by index.
    Cuda(usize),
}

impl TryFrom<String> for Device {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let gpu = || text.strip_prefix("cuda:")?.parse().ok();
        match text.as_str() {
            "cpu" => Ok(Self::Cpu),
            _ => gpu().map(Self::Cuda).ok_or_else(|| {
                format!("device \"{text}\" is neither \"cpu\" nor \"cuda:0\", \"cuda:1\", ...")
            }),
        }
    }
}

impl Infer {
    /// The threads of a network on this machine.
    #[must_use]
    pub fn thread_count(&self) -> usize {
        match self.threads {
            0 => std::thread::available_parallelism()
                .map_or(1, |count| count.get().min(THREADS_DEFAULT_MAX)),
            count => count,
        }
    }
}

impl Default for Config {
    fn default() -> Self {
        Self {
            instance: "noctule".to_owned(),
            grid: Grid::default(),
            strobe: Strobe::default(),
            budget: Budget::default(),
            lanes: Lanes::default(),
            lidar: Lidar::default(),
            infer: Infer::default(),
            can: MotionConfig::default(),
        }
    }
}

impl Default for Grid {
    fn default() -> Self {
        Self {
            width: 256,
            height: 256,
            steps: 8,
            bins: 5,
            depth_m_max: 80.0,
        }
    }
}

impl Default for Strobe {
    fn default() -> Self {
        Self {
            channel: 0,
            active: Active::High,
            open_delay_us: 0,
            close_delay_us: 0,
            virtual_period_ms: 100,
            virtual_width_ms: 100,
        }
    }
}

impl Default for Budget {
    fn default() -> Self {
        Self {
            bundle_ms: 60,
            depth_ms: 400,
        }
    }
}

impl Default for Lanes {
    fn default() -> Self {
        Self {
            event_blocks: 256,
            lidar_packets: 512,
            images: 6,
            motion: 512,
            history_events: 1 << 24,
        }
    }
}

impl Default for Lidar {
    fn default() -> Self {
        Self {
            model: "auto".to_owned(),
            port: 2368,
            angles: None,
            fire_times: None,
        }
    }
}

impl Default for Infer {
    fn default() -> Self {
        Self {
            model: SHIPPED.first().copied().unwrap_or(ModelId::Fill),
            ladder: true,
            threads: 0,
            precision: Precision::Auto,
            device: Device::Cpu,
            weights: BTreeMap::new(),
        }
    }
}

impl Config {
    /// Reads and validates a file.
    ///
    /// # Errors
    /// When it cannot be read or is refused.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|cause| ConfigError::Read {
            path: path.to_owned(),
            cause,
        })?;
        Self::parse(&text, &path.display().to_string())
    }

    /// Validates a text; `origin` names it in errors.
    ///
    /// # Errors
    /// When it is refused.
    pub fn parse(text: &str, origin: &str) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text).map_err(|e| ConfigError::Syntax {
            origin: origin.to_owned(),
            cause: Box::new(e),
        })?;
        config.validate(origin)?;
        Ok(config)
    }

    /// The instance of this configuration.
    ///
    /// # Panics
    /// Never on a validated configuration.
    #[must_use]
    pub fn instance(&self) -> Instance {
        Instance::new(self.instance.parse().expect("the name was validated"))
    }

    /// The layout of its bundles.
    ///
    /// # Panics
    /// Never on a validated configuration.
    #[must_use]
    pub fn bundle_layout(&self) -> BundleLayout {
        let Grid {
            width,
            height,
            steps,
            bins,
            ..
        } = self.grid;
        BundleLayout::new(steps, bins, height, width).expect("the grid was validated")
    }

    /// The layout of its depth frames.
    ///
    /// # Panics
    /// Never on a validated configuration.
    #[must_use]
    pub fn depth_layout(&self) -> DepthLayout {
        DepthLayout::new(self.grid.height, self.grid.width).expect("the grid was validated")
    }

    /// The bounds of its channels.
    #[must_use]
    pub fn limits(&self) -> Limits {
        Limits::new(self.bundle_layout().blocks(), self.depth_layout().blocks())
    }

    /// Checks what types cannot say.
    ///
    /// # Errors
    /// Names the first key that is out of range.
    pub fn validate(&self, origin: &str) -> Result<(), ConfigError> {
        let refuse = |key, value: &dyn ToString, reason: &str| {
            Err(ConfigError::Value {
                origin: origin.to_owned(),
                key,
                value: value.to_string(),
                reason: reason.to_owned(),
            })
        };
        if let Err(error) = self.instance.parse::<InstanceName>() {
            return refuse("instance", &self.instance, &error.to_string());
        }
        let grid = &self.grid;
        if let Err(e) = BundleLayout::new(grid.steps, grid.bins, grid.height, grid.width) {
            let value = format!(
                "{}x{}x{}x{}",
                grid.steps, grid.bins, grid.height, grid.width
            );
            return refuse(
                "grid (steps x bins x height x width)",
                &value,
                &e.to_string(),
            );
        }
        if !(grid.depth_m_max.is_finite() && (1.0..=500.0).contains(&grid.depth_m_max)) {
            return refuse("grid.depth_m_max", &grid.depth_m_max, "1 to 500 metres");
        }
        let strobe = &self.strobe;
        if !(1..=60_000).contains(&strobe.virtual_period_ms) {
            return refuse(
                "strobe.virtual_period_ms",
                &strobe.virtual_period_ms,
                "1 to 60000",
            );
        }
        if strobe.virtual_width_ms == 0 || strobe.virtual_width_ms > strobe.virtual_period_ms {
            let reason = "1 up to strobe.virtual_period_ms";
            return refuse("strobe.virtual_width_ms", &strobe.virtual_width_ms, reason);
        }
        for (key, delay) in [
            ("strobe.open_delay_us", strobe.open_delay_us),
            ("strobe.close_delay_us", strobe.close_delay_us),
        ] {
            if delay.unsigned_abs() > 10_000 {
                return refuse(key, &delay, "-10000 to 10000");
            }
        }
        let budget = &self.budget;
        if !(1..=10_000).contains(&budget.bundle_ms) {
            return refuse("budget.bundle_ms", &budget.bundle_ms, "1 to 10000");
        }
        if budget.depth_ms <= budget.bundle_ms || budget.depth_ms > 60_000 {
            let reason = "more than budget.bundle_ms, which is part of it, up to 60000";
            return refuse("budget.depth_ms", &budget.depth_ms, reason);
        }
        self.validate_lanes(&refuse)?;
        if self.lidar.model != "auto"
            && noctule_hesai::Model::from_name(&self.lidar.model).is_none()
        {
            let reason = "auto, qt64, qt128, xt32, xt16, xt32m, pandar64 or pandar40p";
            return refuse("lidar.model", &self.lidar.model, reason);
        }
        if let Err(error) = noctule_can::MotionDecoder::new(&self.can) {
            return refuse("can", &"speed, yaw_rate", &error.to_string());
        }
        for (model, path) in &self.infer.weights {
            if *model < ModelId::Xs {
                return refuse(
                    "infer.weights",
                    &path.display(),
                    "only xs, s and full have weights",
                );
            }
        }
        if self.infer.threads > THREADS_MAX {
            let reason = "a network is run by at most 64 threads";
            return refuse("infer.threads", &self.infer.threads, reason);
        }
        let model = self.infer.model;
        let is_there = self.infer.weights.contains_key(&model) || SHIPPED.contains(&model);
        if model >= ModelId::Xs && !is_there {
            let reason = "the model has no file under [infer.weights], and none ships";
            return refuse("infer.model", &self.infer.model, reason);
        }
        Ok(())
    }

    fn validate_lanes(&self, refuse: &Refuse<'_>) -> Result<(), ConfigError> {
        let lanes = &self.lanes;
        for (key, blocks, least) in [
            ("lanes.event_blocks", lanes.event_blocks, 8),
            ("lanes.lidar_packets", lanes.lidar_packets, 8),
            ("lanes.images", lanes.images, 2),
            ("lanes.motion", lanes.motion, 8),
        ] {
            if !(least..=65_536).contains(&blocks) {
                refuse(key, &blocks, &format!("{least} to 65536"))?;
            }
        }
        let history = lanes.history_events;
        if !history.is_power_of_two() || !(1 << 16..=1 << 28).contains(&history) {
            refuse(
                "lanes.history_events",
                &history,
                "a power of two from 65536 to 268435456",
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shipped_file_states_the_defaults() {
        assert_eq!(
            Config::parse(DEFAULT_TOML, "noctule.toml").unwrap(),
            Config::default()
        );
    }
}
