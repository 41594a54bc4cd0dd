//! What makes settings wrong, each thing named with its key and value.

use std::ops::Range;
use std::path::PathBuf;

use noctule_erunet::{ConfigError, SIDE_MULTIPLE};
use noctule_world::STEPS;
use thiserror::Error;

use super::{
    Augment, Drives, Kind, KittiDrives, Loss, Settings, Stage, TEST_SEEDS, VALIDATION_SEEDS, nights,
};
use crate::cache::Nights;

/// Why settings describe no training run.
#[derive(Debug, Error)]
pub enum SettingsError {
    /// The file could not be read.
    #[error("{}: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The text is not TOML of the wanted form.
    #[error("settings are not readable: {0}")]
    Toml(String),
    /// The network is not one.
    #[error(transparent)]
    Network(#[from] ConfigError),
    /// A tier is not one.
    #[error(transparent)]
    Tier(#[from] noctule_world::UnknownTier),
    /// A number is out of range.
    #[error("{key} is {value}, wanted {wanted}")]
    Number {
        /// Where in the file.
        key: String,
        /// What it says.
        value: String,
        /// What would be right.
        wanted: String,
    },
}

pub(super) fn number(
    key: impl Into<String>,
    value: impl ToString,
    wanted: impl Into<String>,
) -> SettingsError {
    SettingsError::Number {
        key: key.into(),
        value: value.to_string(),
        wanted: wanted.into(),
    }
}

fn share(key: &str, value: f64) -> Result<(), SettingsError> {
    if (0.0..=1.0).contains(&value) {
        Ok(())
    } else {
        Err(number(key, value, "0 to 1"))
    }
}

impl Settings {
    pub(super) fn check(&self) -> Result<(), SettingsError> {
        self.network()?;
        if self.threads == 0 {
            return Err(number("threads", 0, "1 or more"));
        }
        if !(0.0..1.0).contains(&self.average) {
            return Err(number("average", self.average, "0 to below 1"));
        }
        self.gpu()?;
        self.check_data()?;
        self.augment.check()?;
        self.loss.check("loss")?;
        if self.stages.is_empty() {
            return Err(number("stages", "empty", "one or more"));
        }
        let restores = self.network()?.has_efr();
        for (index, stage) in self.stages.iter().enumerate() {
            stage.check(index, self.data.size)?;
            if !restores && stage.kind == Kind::Restore {
                let key = format!("stages[{index}].kind");
                return Err(number(key, "1", "another: the variant restores nothing"));
            }
        }
        Ok(())
    }

    fn check_data(&self) -> Result<(), SettingsError> {
        let data = &self.data;
        if data.size == 0 || data.size > 256 || !data.size.is_multiple_of(SIDE_MULTIPLE) {
            return Err(number("data.size", data.size, "a multiple of 16 up to 256"));
        }
        if !(1..=64).contains(&data.loaders) {
            return Err(number("data.loaders", data.loaders, "1 to 64"));
        }
        if let Some(kitti) = &data.kitti {
            kitti.check()?;
        }
        let only_kitti = data.kitti.as_ref().is_some_and(|kitti| kitti.share >= 1.0);
        let validates_kitti = data.kitti.as_ref().is_some_and(|k| k.validation.is_some());
        if only_kitti && !data.train.is_empty() {
            let value = format!("{} ranges", data.train.len());
            return Err(number(
                "data.train",
                value,
                "none beside a KITTI share of 1",
            ));
        }
        for (key, drives, is_optional) in [
            ("data.train", &data.train, only_kitti),
            ("data.validation", &data.validation, validates_kitti),
        ] {
            if drives.is_empty() && !is_optional {
                return Err(number(key, "empty", "one range of seeds or more"));
            }
        }
        check_drives("data.train", &data.train, 0..VALIDATION_SEEDS)?;
        check_drives(
            "data.validation",
            &data.validation,
            VALIDATION_SEEDS..TEST_SEEDS,
        )
    }
}

impl KittiDrives {
    fn check(&self) -> Result<(), SettingsError> {
        let run = |name: &str, [first, last]: [u32; 2], least: u32| {
            let is_run = first <= last && last < u32::MAX && last - first >= least - 1;
            is_run.then_some(()).ok_or_else(|| {
                number(
                    format!("data.kitti.{name}"),
                    format!("[{first}, {last}]"),
                    format!("first and last frame, both included, {least} frames or more"),
                )
            })
        };
        run("frames", self.frames, 4)?;
        if let Some(validation) = self.validation {
            run("validation", validation, 1)?;
            if validation[0] <= self.frames[1] && self.frames[0] <= validation[1] {
                let value = format!("[{}, {}]", validation[0], validation[1]);
                let wanted = "none of the frames that are trained on";
                return Err(number("data.kitti.validation", value, wanted));
            }
        }
        if !(1..=256).contains(&self.cuts) {
            return Err(number("data.kitti.cuts", self.cuts, "1 to 256"));
        }
        if !(self.share > 0.0 && self.share <= 1.0) {
            let wanted = "above 0, up to 1";
            return Err(number("data.kitti.share", self.share, wanted));
        }
        Ok(())
    }
}

/// No seed outside `allowed`, none twice in a tier.
fn check_drives(key: &str, drives: &[Drives], allowed: Range<u64>) -> Result<(), SettingsError> {
    let nights = nights(drives)?;
    for (index, night) in nights.iter().enumerate() {
        let Range { start, end } = night.seeds;
        if start >= end || start < allowed.start || end > allowed.end {
            return Err(number(
                format!("{key}[{index}].seeds"),
                format!("{start}..{end}"),
                format!("a range within {}..{}", allowed.start, allowed.end),
            ));
        }
        let overlaps = |other: &Nights| {
            other.tier == night.tier && other.seeds.start < end && start < other.seeds.end
        };
        if nights[..index].iter().any(overlaps) {
            let value = format!("{start}..{end}");
            return Err(number(
                format!("{key}[{index}].seeds"),
                value,
                "no seed twice in a tier",
            ));
        }
    }
    Ok(())
}

impl Augment {
    pub(super) fn check(&self) -> Result<(), SettingsError> {
        share("augment.flip", self.flip)?;
        share("augment.over_movers", self.over_movers)?;
        share("augment.event_drop_max", self.event_drop_max)?;
        share("augment.return_drop_max", self.return_drop_max)?;
        share("augment.zoom", self.zoom)?;
        share("augment.ring_drop_max", self.ring_drop_max)?;
        share("augment.ground_unknown", self.ground_unknown)?;
        for (key, value, [low, high]) in [
            ("event_noise_max", self.event_noise_max, [0.0, 10.0]),
            ("zoom_max", self.zoom_max, [1.0, 8.0]),
            ("event_threshold_max", self.event_threshold_max, [1.0, 16.0]),
            ("event_lag_us_max", self.event_lag_us_max, [0.0, 1e6]),
            ("event_dead_us_max", self.event_dead_us_max, [0.0, 1e6]),
            ("range_noise_m_max", self.range_noise_m_max, [0.0, 10.0]),
            ("read_noise_max", self.read_noise_max, [0.0, 1.0]),
            (
                "ground_shift_rows_max",
                self.ground_shift_rows_max,
                [0.0, 256.0],
            ),
        ] {
            if !(low..=high).contains(&value) {
                let key = format!("augment.{key}");
                return Err(number(key, value, format!("{low} to {high}")));
            }
        }
        if !(1..=64).contains(&self.ring_stride_max) {
            let key = "augment.ring_stride_max";
            return Err(number(key, self.ring_stride_max, "1 to 64"));
        }
        if !(1..=8).contains(&self.picture_bits_min) {
            let key = "augment.picture_bits_min";
            return Err(number(key, self.picture_bits_min, "1 to 8"));
        }
        let [low, high] = self.gain;
        if !(low > 0.0 && low <= high && high <= 100.0) {
            let value = format!("[{low}, {high}]");
            return Err(number(
                "augment.gain",
                value,
                "two factors above 0, up to 100, in order",
            ));
        }
        Ok(())
    }
}

impl Loss {
    fn check(&self, table: &str) -> Result<(), SettingsError> {
        let weights = [
            ("charbonnier", self.charbonnier),
            ("charbonnier_guard", self.charbonnier_guard),
            ("ssim", self.ssim),
            ("edge", self.edge),
            ("reblur", self.reblur),
            ("gradient", self.gradient),
            ("sparse", self.sparse),
            ("contrast", self.contrast),
            ("log_depth", self.log_depth),
            ("depth_edges", self.depth_edges),
            ("depth_movers", self.depth_movers),
            ("mover_mean", self.mover_mean),
            ("restored_power", self.restored_power),
        ];
        match weights
            .iter()
            .find(|(_, weight)| !(0.0..=1e3).contains(weight))
        {
            Some((key, value)) => Err(number(format!("{table}.{key}"), value, "0 to 1000")),
            None => Ok(()),
        }
    }
}

impl Stage {
    pub(super) fn check(&self, index: usize, size: usize) -> Result<(), SettingsError> {
        let key = |name: &str| format!("stages[{index}].{name}");
        if self.steps == 0 {
            return Err(number(key("steps"), 0, "1 or more"));
        }
        if !(1..=64).contains(&self.batch) {
            return Err(number(key("batch"), self.batch, "1 to 64"));
        }
        if self.crop == 0 || self.crop > size || !self.crop.is_multiple_of(SIDE_MULTIPLE) {
            let wanted = format!("a multiple of {SIDE_MULTIPLE} up to {size}");
            return Err(number(key("crop"), self.crop, wanted));
        }
        if !(1..=STEPS).contains(&self.window) {
            return Err(number(key("window"), self.window, format!("1 to {STEPS}")));
        }
        let [start, end] = self.rate;
        if !(start > 0.0 && start <= 1.0 && end >= 0.0 && end <= start) {
            let value = format!("[{start}, {end}]");
            return Err(number(key("rate"), value, "two rates up to 1, not rising"));
        }
        if self
            .clip_norm
            .is_some_and(|norm| norm.is_nan() || norm <= 0.0)
        {
            return Err(number(
                key("clip_norm"),
                format!("{:?}", self.clip_norm),
                "above 0",
            ));
        }
        if self.validate_every == 0 || self.checkpoint_every == 0 {
            return Err(number(
                key("validate_every"),
                0,
                "1 or more, as checkpoint_every",
            ));
        }
        if let Some(loss) = &self.loss {
            loss.check(&key("loss"))?;
        }
        share(&key("collapse_margin"), self.collapse_margin)
    }
}
