//! What an exposure is, and what is said about it while it comes and goes.

use core::fmt;
use core::ops::{BitOr, BitOrAssign};

use noctule_sensor::{Evk4, Monotonic, Realtime, Stamp};

/// What is unusual about an exposure; several may hold.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ExposureFlags(u16);

impl ExposureFlags {
    /// Nothing unusual.
    pub const NONE: Self = Self(0);
    /// The opening edge was missing and was put back one width before the closing edge.
    pub const OPEN_REPAIRED: Self = Self(1);
    /// The closing edge was missing and was put one width behind the opening edge.
    pub const CLOSE_REPAIRED: Self = Self(2);
    /// An edge came with the wrong polarity and was taken for what its place in time says.
    pub const EDGE_INVERTED: Self = Self(4);
    /// The width is the image's exposure set, not a measured one.
    pub const WIDTH_NOMINAL: Self = Self(8);
    /// There was no strobe: the interval was made up from sweeps, a period or an image's stamps.
    pub const VIRTUAL: Self = Self(16);
    /// The image that should belong to it never came or could not be told apart: see the counts.
    pub const IMAGE_MISSING: Self = Self(32);
    /// A clock was restarted or stepped while the exposure was in flight.
    pub const CLOCK_CHANGED: Self = Self(64);

    /// The flags as bits, for a header.
    #[must_use]
    pub const fn bits(self) -> u16 {
        self.0
    }

    /// Whether every flag of `other` is set.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Whether any flag of `other` is set.
    #[must_use]
    pub const fn intersects(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }
}

impl BitOr for ExposureFlags {
    type Output = Self;
    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl BitOrAssign for ExposureFlags {
    fn bitor_assign(&mut self, other: Self) {
        self.0 |= other.0;
    }
}

impl fmt::Debug for ExposureFlags {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const NAMES: [&str; 7] = [
            "open repaired",
            "close repaired",
            "edge inverted",
            "width nominal",
            "virtual",
            "image missing",
            "clock changed",
        ];
        f.write_str("[")?;
        let set = NAMES
            .iter()
            .enumerate()
            .filter(|(bit, _)| self.0 >> bit & 1 == 1);
        for (place, (_, name)) in set.enumerate() {
            let separator = if place == 0 { "" } else { ", " };
            write!(f, "{separator}{name}")?;
        }
        f.write_str("]")
    }
}

/// The interval the shutter was open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exposure {
    /// Counts the exposures announced, from 0; never reused.
    pub id: u64,
    /// Shutter opens, edge delays taken off.
    pub open: Stamp<Evk4>,
    /// Shutter closes, edge delays taken off.
    pub close: Stamp<Evk4>,
    /// Driver's sequence number of the image taken with it.
    pub image: Option<u64>,
    /// What is unusual about it.
    pub flags: ExposureFlags,
}

impl Exposure {
    /// Nanoseconds from open to close.
    #[must_use]
    pub fn width_ns(&self) -> i64 {
        self.close.diff_nanos(self.open)
    }
}

/// Which instant of the exposure a driver stamp means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StampedAt {
    /// Start of exposure.
    Start,
    /// End of exposure.
    End,
}

/// What is known of an image besides its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageStamp {
    /// The driver's frame counter.
    pub sequence: u64,
    /// The driver's stamp.
    pub driver: Stamp<Monotonic>,
    /// What that stamp means.
    pub stamped_at: StampedAt,
    /// Exposure time the camera was set to, nanoseconds, if known.
    pub exposure_ns: Option<i64>,
    /// When the frame reached the host.
    pub arrival: Stamp<Realtime>,
}

/// Why an announced exposure came to nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DiscardReason {
    /// The pulse was shorter than any exposure.
    Glitch,
    /// Its closing edge never came and no width was known to put it back.
    NeverClosed,
    /// An edge in step with the camera's period showed that its opening edge was noise.
    OutOfStep,
    /// The event camera's counter was restarted or jumped.
    ClockChanged,
}

/// Why an image was attached to no exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LeftOutReason {
    /// No exposure lies where its stamp points.
    NoExposure,
    /// More than one exposure could be meant.
    Ambiguous,
    /// The exposure there is not as wide as the camera was set to.
    WidthMismatch,
    /// The exposure there already has an image, or the stamp is not newer than the last one.
    Duplicate,
    /// No clock map good enough to tell came in time.
    NoMap,
    /// A clock was restarted or jumped before it could be placed.
    ClockChanged,
}

/// An edge seen by two clocks: feed it to the paired fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StrobePair {
    /// On the event camera's counter.
    pub edge: Stamp<Evk4>,
    /// As the frame's driver stamped it.
    pub driver: Stamp<Monotonic>,
}

/// A step in the life of an exposure.
///
/// An exposure is `Opened`, then either `Discarded` or `Closed`; a closed one ends with exactly
/// one of `Imaged` and `ImageMissing`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExposureEvent {
    /// The shutter opened.
    Opened {
        /// Of the exposure to be.
        id: u64,
        /// When.
        open: Stamp<Evk4>,
        /// When it should close, if the last width still holds.
        close_predicted: Option<Stamp<Evk4>>,
        /// What is unusual so far.
        flags: ExposureFlags,
    },
    /// The shutter closed; no image has been matched yet.
    Closed(Exposure),
    /// It was none.
    Discarded {
        /// Of the exposure announced.
        id: u64,
        /// Why.
        reason: DiscardReason,
    },
    /// Its image is known; `close` may have moved if its edge had been put back.
    Imaged {
        /// The exposure, with its image.
        exposure: Exposure,
        /// For the paired fit, when the edge was measured.
        pair: Option<StrobePair>,
    },
    /// It will have no image.
    ImageMissing(Exposure),
    /// An image belongs to no exposure.
    ImageLeftOut {
        /// The driver's frame counter.
        sequence: u64,
        /// Why.
        reason: LeftOutReason,
    },
}

/// Edges, exposures and images by what became of them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ExposureCounts {
    /// Edges offered on the strobe's input.
    pub edges: u64,
    /// Edges on other inputs.
    pub edges_elsewhere: u64,
    /// Edges repeated by a bouncing line or a doubled report.
    pub edges_doubled: u64,
    /// Edges that fit no exposure.
    pub edges_stray: u64,
    /// Edges taken for the opposite polarity.
    pub edges_inverted: u64,
    /// Edges put back.
    pub edges_repaired: u64,
    /// Exposures announced.
    pub opened: u64,
    /// Exposures closed.
    pub closed: u64,
    /// Exposures that came to nothing.
    pub discarded: u64,
    /// Images offered.
    pub images: u64,
    /// Images the driver counted and never delivered.
    pub images_lost: u64,
    /// Images attached.
    pub images_matched: u64,
    /// Exposures that ended without an image.
    pub images_missing: u64,
    /// Images attached to nothing because nothing lay there.
    pub left_out_no_exposure: u64,
    /// Images attached to nothing because two exposures could be meant.
    pub left_out_ambiguous: u64,
    /// Images attached to nothing because the widths disagree. Most images ending here is the
    /// sign of a strobe polarity set the wrong way round.
    pub left_out_width: u64,
    /// Images attached to nothing because one was there already.
    pub left_out_duplicate: u64,
    /// Images attached to nothing for want of a clock map.
    pub left_out_no_map: u64,
    /// Images attached to nothing because a clock changed.
    pub left_out_clock: u64,
    /// Times the event camera's counter was restarted or jumped.
    pub clock_changes: u64,
}
