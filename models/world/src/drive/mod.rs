//! A whole drive as a recording: what the sensors put on the wire, with arrivals, and the truth.
//!
//! Written as it is rendered, in memory that does not grow with the drive but for its timeline.

mod events;
mod images;
mod lidar;

use std::path::Path;
use std::time::Duration;

use noctule_camera::Encoding;
use noctule_can::{MotionConfig, MotionEncoder};
use noctule_recording::{
    CameraMeta, CanMeta, Counts, EventsMeta, Generator, GridSize, LidarMeta, Meta, RecordingWriter,
    Rectangle, Split, StrobeMeta, StrobePolarity, TruthWriter,
};

use crate::chance::{Dice, Purpose};
use crate::error::WorldError;
use crate::faults::Faults;
use crate::optics::Optics;
use crate::render::{Frame, render};
use crate::rig::{DRIVE_START_TAI, Rig, SENSOR};
use crate::scene::Scene;
use crate::shutter::{STEPS, Tier, idle_step_s, sub_frames};
use crate::snapshot::{Horizon, Snapshot};
use crate::timeline::{STROBE_CHANNEL, Timeline};

/// What to record.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveOptions {
    /// The night.
    pub seed: u64,
    /// How hard.
    pub tier: Tier,
    /// How long, 0.1 to 1200 s.
    pub duration: Duration,
    /// Sensors, clocks and delays.
    pub rig: Rig,
    /// What goes wrong.
    pub faults: Faults,
}

impl DriveOptions {
    /// A drive with the default rig and no faults.
    #[must_use]
    pub fn new(seed: u64, tier: Tier, duration: Duration) -> Self {
        Self {
            seed,
            tier,
            duration,
            rig: Rig::new(seed, tier),
            faults: Faults::default(),
        }
    }

    fn validate(&self) -> Result<(), WorldError> {
        if !(0.1..=1200.0).contains(&self.duration.as_secs_f64()) {
            return Err(WorldError::Duration(self.duration));
        }
        let bad = |name, value, needed| {
            Err(WorldError::Rig {
                name,
                value,
                needed,
            })
        };
        let rig = &self.rig;
        if !rig.size.is_multiple_of(32) || !(32..=704).contains(&rig.size) {
            return bad("size", rig.size as u64, "a multiple of 32 up to 704");
        }
        if rig.grid == 0 || !rig.grid.is_multiple_of(16) || !rig.size.is_multiple_of(rig.grid) {
            return bad(
                "grid",
                rig.grid as u64,
                "a multiple of 16 that divides the size",
            );
        }
        if !(100..=100_000).contains(&rig.transfer_us) {
            return bad("transfer_us", rig.transfer_us, "100 to 100000");
        }
        let shutter = rig.shutter;
        if shutter.exposure_ns == 0 || shutter.exposure_ns >= shutter.period_ns {
            return bad(
                "shutter.exposure_ns",
                shutter.exposure_ns,
                "positive and below the period",
            );
        }
        self.faults.validate()
    }
}

/// How far a recording has come.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveProgress {
    /// Time of the drive that was rendered, seconds.
    pub rendered_s: f64,
    /// Length of the drive, seconds.
    pub total_s: f64,
}

/// What was recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DriveSummary {
    /// Complete exposures, each with its truth.
    pub exposures: u64,
    /// Events, those in lost transfers not counted.
    pub events: u64,
    /// Instants rendered at the camera's size.
    pub frames: u64,
    /// What the recording holds.
    pub counts: Counts,
}

/// Renders and records a drive into `dir`, which must not hold a recording yet. The same options
/// give the same bytes with any number of threads; `progress` is called after every
/// rendered instant.
///
/// # Errors
/// When the options make no sense or a file cannot be written.
pub fn record_drive(
    options: &DriveOptions,
    dir: &Path,
    mut progress: impl FnMut(DriveProgress),
) -> Result<DriveSummary, WorldError> {
    options.validate()?;
    let total_s = options.duration.as_secs_f64();
    let scene = Scene::new(options.seed, total_s, options.tier.drives());
    let timeline = Timeline::simulate(&options.rig, &options.faults, options.seed, total_s);
    let mut recording = RecordingWriter::create(dir, meta(options), &options.rig.calibration)?;
    let mut truth = TruthWriter::create(dir, STEPS as u32)?;
    truth.clocks(&options.rig.clocks.to_truth())?;
    for &reading in &timeline.readings {
        recording.clock_reading(reading)?;
    }
    let mut drive = Drive {
        events: events::EventStream::new(options, &timeline, &mut recording)?,
        images: images::ImageStream::new(options, &scene, &timeline),
        lidar: lidar::LidarStream::new(options, &timeline)?,
        options,
        scene: &scene,
        timeline: &timeline,
        frame: Frame::new(options.rig.size),
        frames: 0,
        progress: &mut progress,
    };
    drive.write_motion(&mut recording)?;
    drive.run(&mut recording, &mut truth)?;
    let (events, frames) = (drive.events.finish(&mut recording)?, drive.frames);
    truth.finish()?;
    progress(DriveProgress {
        rendered_s: total_s,
        total_s,
    });
    Ok(DriveSummary {
        exposures: timeline.exposures.len() as u64,
        events,
        frames,
        counts: recording.finish()?,
    })
}

/// A drive under way.
struct Drive<'a> {
    options: &'a DriveOptions,
    scene: &'a Scene,
    timeline: &'a Timeline,
    events: events::EventStream<'a>,
    images: images::ImageStream<'a>,
    lidar: lidar::LidarStream<'a>,
    frame: Frame,
    frames: u64,
    progress: &'a mut dyn FnMut(DriveProgress),
}

impl Drive<'_> {
    /// Goes through the drive exposure by exposure, and through the gaps between them.
    fn run(
        &mut self,
        recording: &mut RecordingWriter,
        truth: &mut TruthWriter,
    ) -> Result<(), WorldError> {
        let total_s = self.options.duration.as_secs_f64();
        let optics = Optics::new(self.options.rig.size);
        // The event pixels settle during an eighth of a second before the drive.
        let mut now_s = -0.125;
        for timed in &self.timeline.exposures {
            let opening = timed.opening;
            let count = sub_frames(self.scene, &opening, &optics);
            self.idle(now_s, opening.at(0.5 / count as f64), &optics, recording)?;
            for i in 0..count {
                now_s = opening.at((i as f64 + 0.5) / count as f64);
                self.look(now_s, &optics, recording)?;
                self.images.gather(&self.frame, 1.0 / count as f32);
            }
            self.lidar
                .send_until(self.scene, opening.close_ns, recording)?;
            self.images
                .develop(timed, &mut self.lidar, recording, truth)?;
        }
        self.idle(now_s, total_s + 1e-3, &optics, recording)?;
        self.lidar.send_until(self.scene, u64::MAX, recording)
    }

    /// Lets time pass from a rendered instant up to, not including, `end_s`.
    fn idle(
        &mut self,
        start_s: f64,
        end_s: f64,
        optics: &Optics,
        recording: &mut RecordingWriter,
    ) -> Result<(), WorldError> {
        let steps = ((end_s - start_s) / idle_step_s(self.scene, start_s.max(0.0), optics))
            .ceil()
            .max(1.0);
        for i in 1..steps as u64 {
            self.look(
                start_s + (end_s - start_s) * i as f64 / steps,
                optics,
                recording,
            )?;
        }
        if end_s > self.options.duration.as_secs_f64() {
            self.look(end_s, optics, recording)?;
        }
        Ok(())
    }

    /// Renders one instant and shows it to the event camera.
    fn look(
        &mut self,
        t_s: f64,
        optics: &Optics,
        recording: &mut RecordingWriter,
    ) -> Result<(), WorldError> {
        let snapshot = Snapshot::new(self.scene, t_s, Horizon::CAMERA);
        render(self.scene, &snapshot, optics, &mut self.frame);
        self.frames += 1;
        let total_s = self.options.duration.as_secs_f64();
        (self.progress)(DriveProgress {
            rendered_s: t_s.clamp(0.0, total_s),
            total_s,
        });
        self.events.step(&self.frame.luma, t_s, recording)
    }

    /// Speed and yaw rate with the noise of their sensors.
    fn write_motion(&mut self, recording: &mut RecordingWriter) -> Result<(), WorldError> {
        let encoder = MotionEncoder::new(&MotionConfig::default())?;
        for (index, timed) in self.timeline.motion.iter().enumerate() {
            let t_s = timed.measured.diff_nanos(DRIVE_START_TAI) as f64 * 1e-9;
            let (speed, yaw_rate) =
                measured_motion(self.scene, self.options.seed, index as u64, t_s);
            let (first, second) = encoder.encode(speed, yaw_rate)?;
            recording.can(first, timed.arrival)?;
            if let Some(second) = second {
                // The next frame on a 500 kbit/s bus.
                recording.can(second, timed.arrival.offset_nanos(230_000))?;
            }
        }
        Ok(())
    }
}

/// Speed noise, m/s, and yaw rate noise, rad/s.
const MOTION_NOISE: (f64, f64) = (0.02, 0.002);

/// The `index`-th measurement of speed (m/s) and yaw rate (rad/s).
fn measured_motion(scene: &Scene, seed: u64, index: u64, t_s: f64) -> (f64, f64) {
    let mut dice = Dice::numbered(seed, Purpose::Motion, index | 1 << 40);
    let (speed, yaw_rate) = scene.ego_motion(t_s);
    let noisy = speed + MOTION_NOISE.0 * dice.normal();
    // Wheels that stand report zero.
    let speed = if speed == 0.0 { 0.0 } else { noisy.max(0.0) };
    (speed, yaw_rate + MOTION_NOISE.1 * dice.normal())
}

fn meta(options: &DriveOptions) -> Meta {
    let (seed, size, grid) = (
        options.seed,
        options.rig.size as u32,
        options.rig.grid as u32,
    );
    Meta {
        name: format!("world-{seed}-{}", options.tier.letter()),
        generator: Some(Generator {
            name: env!("CARGO_PKG_NAME").to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            seed,
        }),
        split: Some(match seed {
            0..100_000 => Split::Train,
            100_000..200_000 => Split::Val,
            _ => Split::Test,
        }),
        steps: STEPS as u32,
        crop: Rectangle {
            x: 0,
            y: 0,
            width: size,
            height: size,
        },
        network: GridSize {
            width: grid,
            height: grid,
        },
        events: Some(EventsMeta {
            serial: format!("world-{seed}"),
            width: SENSOR.0 as u32,
            height: SENSOR.1 as u32,
            strobe: Some(StrobeMeta {
                channel: STROBE_CHANNEL,
                polarity: StrobePolarity::ActiveHigh,
                open_delay_ns: 0,
                close_delay_ns: 0,
            }),
        }),
        camera: Some(CameraMeta {
            serial: format!("world-{seed}"),
            width: size,
            height: size,
            encoding: Encoding::Gamma22,
            bit_depth: 8,
        }),
        lidar: Some(LidarMeta {
            serial: format!("world-{seed}"),
            model: "PandarQT64".to_owned(),
            port: 2368,
        }),
        can: Some(CanMeta {
            interface: "can0".to_owned(),
            motion: MotionConfig::default(),
        }),
    }
}
