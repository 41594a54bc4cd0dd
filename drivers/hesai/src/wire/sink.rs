//! Where returns go: one by one, or a firing at a time.

use noctule_sensor::{Lidar, Return, Stamp};

/// Takes returns as they are decoded.
pub trait ReturnSink {
    /// Takes one return of sweep number `sweep`.
    ///
    /// Sweeps are numbered by turns of the head from 0 on, whether or not all of a turn was
    /// received. Near a seam two numbers alternate: channels cross the cut one by one.
    fn on_return(&mut self, r: Return, sweep: u32);

    /// Takes one firing whole: its `R` blocks, one per echo.
    ///
    /// A sink that works on vectors takes [`Block`]s apart by itself; `#[inline(always)]` then has
    /// its loops compiled for the vectors of the machine it runs on. Left alone, every return
    /// goes to [`on_return`](Self::on_return), channel by channel.
    #[inline]
    fn on_firing<const R: usize>(&mut self, blocks: &[Block<'_>; R]) {
        for (c, channel) in (0..blocks[0].echo.len()).zip(0u8..) {
            for block in blocks {
                if let Some(r) = block.get(channel) {
                    self.on_return(r, block.sweep_of(c));
                }
            }
        }
    }
}

impl<F: FnMut(Return, u32)> ReturnSink for F {
    #[inline]
    fn on_return(&mut self, r: Return, sweep: u32) {
        self(r, sweep);
    }
}

/// All channels of one block, as arrays of equal length: what a sink takes that works on whole
/// vectors. See [`ReturnSink::on_firing`].
#[derive(Debug, Clone, Copy)]
pub struct Block<'a> {
    /// Metres; 0 where there is no return.
    pub x_m: &'a [f32],
    /// Metres; 0 where there is no return.
    pub y_m: &'a [f32],
    /// Metres; 0 where there is no return.
    pub z_m: &'a [f32],
    /// Distance in the packet's units (16 bits) and, above it, intensity (8 bits), as on the wire;
    /// 0 where there is no return.
    pub echo: &'a [u32],
    /// Firing time after `t`, nanoseconds.
    pub fire_ns: &'a [i32],
    /// When the block began to fire.
    pub t: Stamp<Lidar>,
    /// Azimuth of the block, hundredths of a degree.
    pub azimuth_cdeg: u16,
    /// Index of the block in its packet.
    pub block: u8,
    /// Block azimuth at which a channel's own is zero, `0..36_000`.
    pub(super) zero: &'a [u16],
    /// Block angle at which a channel crosses the cut.
    pub(super) cut: &'a [i32],
    /// The least sweep, and the block's angle past that sweep's start.
    pub(super) sweep: (u32, i32),
    /// Whether channels of two sweeps are here.
    pub(super) seam: bool,
}

impl Block<'_> {
    /// The sweep all channels belong to; `None` while the block crosses the cut.
    #[inline]
    #[must_use]
    pub fn sweep(&self) -> Option<u32> {
        (!self.seam).then_some(self.sweep.0)
    }

    /// The sweep `channel` belongs to.
    ///
    /// # Panics
    /// When there is no such channel.
    #[inline]
    #[must_use]
    pub fn sweep_of(&self, channel: usize) -> u32 {
        if !self.seam {
            return self.sweep.0;
        }
        let (number, angle) = self.sweep;
        number + u32::from(angle - self.cut[channel] >= 36_000)
    }

    /// The return of `channel`, if it has one.
    ///
    /// # Panics
    /// When there is no such channel.
    #[inline]
    #[must_use]
    pub fn get(&self, channel: u8) -> Option<Return> {
        let c = usize::from(channel);
        let [low, high, intensity, _] = self.echo[c].to_le_bytes();
        if low == 0 && high == 0 {
            return None;
        }
        Some(Return {
            t: self.t.offset_nanos(i64::from(self.fire_ns[c])),
            x_m: self.x_m[c],
            y_m: self.y_m[c],
            z_m: self.z_m[c],
            azimuth_cdeg: behind(self.azimuth_cdeg, self.zero[c]),
            channel,
            intensity,
            block: self.block,
        })
    }
}

/// `azimuth` seen from `zero`, both in `0..36_000`.
#[inline]
fn behind(azimuth: u16, zero: u16) -> u16 {
    if azimuth >= zero {
        azimuth - zero
    } else {
        azimuth + (36_000 - zero)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn azimuths_wrap_both_ways() {
        assert_eq!(behind(10, 35_127), 883);
        assert_eq!(behind(10, 790), 35_220);
        assert_eq!(behind(35_999, 0), 35_999);
        assert_eq!(behind(790, 790), 0);
    }
}
