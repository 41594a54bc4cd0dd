//! Why something could not be rastered: what was wrong with what, in numbers.

/// Why a raster could not be built or filled.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RasterError {
    /// A caller's slice has another length than the shape needs.
    #[error("{what} has {actual} elements, needs {needed}")]
    Length {
        /// Which slice.
        what: &'static str,
        /// Elements the shape needs.
        needed: usize,
        /// Elements the caller gave.
        actual: usize,
    },
    /// A grid or crop without pixels, or with a side longer than this crate indexes.
    #[error("{what} is {width}x{height} pixels, each side must be 1..={limit}")]
    Size {
        /// Which rectangle.
        what: &'static str,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Longest side.
        limit: u32,
    },
    /// A crop that reaches beyond its sensor.
    #[error("crop {width}x{height} at ({x}, {y}) leaves the {sensor_width}x{sensor_height} sensor")]
    Crop {
        /// First column of the crop.
        x: u32,
        /// First row of the crop.
        y: u32,
        /// Columns of the crop.
        width: u32,
        /// Rows of the crop.
        height: u32,
        /// Columns of the sensor.
        sensor_width: u32,
        /// Rows of the sensor.
        sensor_height: u32,
    },
    /// An image of another size than the sensor it should come from.
    #[error("image is {width}x{height} pixels, needs {needed_width}x{needed_height}")]
    ImageSize {
        /// Columns it has.
        width: u32,
        /// Rows it has.
        height: u32,
        /// Columns of the sensor.
        needed_width: u32,
        /// Rows of the sensor.
        needed_height: u32,
    },
    /// A lens parameter that describes no lens.
    #[error("camera parameter {name} is {value}")]
    Camera {
        /// Which parameter.
        name: &'static str,
        /// Its value.
        value: f64,
    },
    /// An event pixel that does not fit the 11 bits per axis of a packed event.
    #[error("event at ({x}, {y}) lies beyond pixel 2047")]
    Pixel {
        /// Column.
        x: u16,
        /// Row.
        y: u16,
    },
    /// A remap table that names a cell the grid does not have.
    #[error("remap entry {index} names cell {cell} of a grid of {cells}")]
    Remap {
        /// Index of the entry, row-major over the sensor.
        index: usize,
        /// The cell it names.
        cell: u32,
        /// Cells of the grid.
        cells: usize,
    },
    /// An exposure that does not end after it starts, or lasts longer than the arithmetic is exact.
    #[error(
        "exposure opens at {open_us} us and closes at {close_us} us, must last 1..={limit_us} us"
    )]
    Exposure {
        /// Opening, microseconds on the event camera's clock.
        open_us: u64,
        /// Closing, microseconds on the event camera's clock.
        close_us: u64,
        /// Longest exposure.
        limit_us: u32,
    },
    /// A number of steps the arithmetic is not exact for.
    #[error("{steps} steps per exposure, must be 1..={limit}")]
    Steps {
        /// What was asked for.
        steps: usize,
        /// The most there can be.
        limit: usize,
    },
    /// `advance` or `finish` without a `begin` before it.
    #[error("no exposure is open")]
    NotOpen,
    /// More events in one step than integer accumulators are sure to hold.
    #[error("step {step} holds {events} events, sums are exact up to {limit}")]
    StepOverflow {
        /// Step, 0 first.
        step: usize,
        /// Its events.
        events: u64,
        /// The most a step may hold.
        limit: u64,
    },
    /// A setting outside its range.
    #[error("{name} is {value}, must be in {min}..={max}")]
    Setting {
        /// Which setting.
        name: &'static str,
        /// Its value.
        value: f64,
        /// Smallest admissible value.
        min: f64,
        /// Largest admissible value.
        max: f64,
    },
    /// The camera sees so much of the LiDAR's circle that its passes cannot be told apart.
    #[error("camera and channel offsets cover {width_cdeg} of 36000 hundredths of a degree")]
    WindowTooWide {
        /// Arc of block azimuths in which some channel can be seen, hundredths of a degree.
        width_cdeg: u32,
    },
    /// No laser beam ever meets the image.
    #[error("no channel of {channels} can be seen by the camera")]
    NothingVisible {
        /// Channels looked at.
        channels: usize,
    },
    /// The motion log does not reach the instant asked for.
    #[error(
        "motion log covers {oldest_ns}..{newest_ns} ns (TAI) and {reach_ns} ns beyond, not {at_ns}"
    )]
    NotCovered {
        /// The instant asked for, nanoseconds TAI.
        at_ns: u64,
        /// Oldest sample kept.
        oldest_ns: u64,
        /// Newest sample.
        newest_ns: u64,
        /// How far the log may be extrapolated either way.
        reach_ns: u64,
    },
    /// A motion log with no sample in it.
    #[error("motion log is empty")]
    NoMotion,
    /// A motion sample that is not newer than the one before it.
    #[error("motion sample at {at_ns} ns (TAI) is not after {newest_ns}")]
    MotionOrder {
        /// Its stamp, nanoseconds TAI.
        at_ns: u64,
        /// The newest sample so far.
        newest_ns: u64,
    },
    /// A motion sample that is not a number.
    #[error("motion sample has speed {speed_mps} m/s and yaw rate {yaw_rate_rps} rad/s")]
    MotionValue {
        /// Metres per second.
        speed_mps: f32,
        /// Radians per second.
        yaw_rate_rps: f32,
    },
}

/// Checks the length of a caller's slice.
pub(crate) fn check_len(
    what: &'static str,
    needed: usize,
    actual: usize,
) -> Result<(), RasterError> {
    if needed == actual {
        Ok(())
    } else {
        Err(RasterError::Length {
            what,
            needed,
            actual,
        })
    }
}
