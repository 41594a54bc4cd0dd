//! How light became a pixel's value, and back.

use crate::error::RasterError;

/// How a camera turned linear light (0 black, 1 white) into values in 0..=1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Encoding {
    /// Values are proportional to light.
    #[default]
    Linear,
    /// IEC 61966-2-1: a line near black, a power of 2.4 above.
    Srgb,
    /// A plain power of 2.2.
    Gamma22,
}

impl Encoding {
    /// Every encoding.
    pub const ALL: [Self; 3] = [Self::Linear, Self::Srgb, Self::Gamma22];

    /// Its name in files and headers.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Srgb => "srgb",
            Self::Gamma22 => "gamma22",
        }
    }

    /// The encoding of that name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL
            .into_iter()
            .find(|encoding| encoding.name() == name)
    }

    /// Linear light of an encoded value; values outside 0..=1 are clamped.
    #[must_use]
    pub fn to_linear(self, value: f64) -> f64 {
        let value = value.clamp(0.0, 1.0);
        match self {
            Self::Linear => value,
            Self::Srgb if value <= 0.040_45 => value / 12.92,
            Self::Srgb => ((value + 0.055) / 1.055).powf(2.4),
            Self::Gamma22 => value.powf(2.2),
        }
    }

    /// Encoded value of linear light; light outside 0..=1 is clamped.
    #[must_use]
    pub fn from_linear(self, light: f64) -> f64 {
        let light = light.clamp(0.0, 1.0);
        match self {
            Self::Linear => light,
            Self::Srgb if light <= 0.040_45 / 12.92 => light * 12.92,
            Self::Srgb => 1.055 * light.powf(1.0 / 2.4) - 0.055,
            Self::Gamma22 => light.powf(1.0 / 2.2),
        }
    }
}

impl std::str::FromStr for Encoding {
    type Err = UnknownEncoding;

    fn from_str(name: &str) -> Result<Self, UnknownEncoding> {
        Self::from_name(name).ok_or(UnknownEncoding)
    }
}

/// A name that is no encoding's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("unknown image encoding; linear, srgb and gamma22 are known")]
pub struct UnknownEncoding;

/// The 256 codes of an encoding as light, and light as codes, looked up.
///
/// Each way is the other's inverse on codes: `code(light(c)) == c`.
#[derive(Debug, Clone)]
pub struct EncodingTable {
    encoding: Encoding,
    light: Box<[f32; 256]>,
    /// Light half-way, in encoded values, between code i and i + 1.
    edges: Box<[f32; 255]>,
}

impl EncodingTable {
    /// Tabulates an encoding.
    #[must_use]
    pub fn new(encoding: Encoding) -> Self {
        let light_at = |value: f64| encoding.to_linear(value / 255.0) as f32;
        let light = Box::new(std::array::from_fn(|code| light_at(code as f64)));
        let edges = Box::new(std::array::from_fn(|code| light_at(code as f64 + 0.5)));
        Self {
            encoding,
            light,
            edges,
        }
    }

    /// The encoding it tabulates.
    #[must_use]
    pub const fn encoding(&self) -> Encoding {
        self.encoding
    }

    /// Linear light of an 8-bit code, 0..=1.
    #[inline]
    #[must_use]
    pub fn light(&self, code: u8) -> f32 {
        self.light[usize::from(code)]
    }

    /// The 8-bit code nearest, in encoded values, to some linear light; clamped to 0..=255, 0 for
    /// what is not a number.
    #[must_use]
    pub fn code(&self, light: f32) -> u8 {
        let above = self.edges.partition_point(|edge| *edge <= light);
        u8::try_from(above).unwrap_or(u8::MAX) // at most 255: there are 255 edges
    }

    /// Light of a whole row of codes, into `out`.
    ///
    /// # Errors
    /// [`RasterError::Length`], when the two differ in length.
    pub fn lights(&self, codes: &[u8], out: &mut [f32]) -> Result<(), RasterError> {
        crate::error::check_len("linear light", codes.len(), out.len())?;
        for (out, code) in out.iter_mut().zip(codes) {
            *out = self.light(*code);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_survive_the_way_through_light() {
        for encoding in Encoding::ALL {
            let table = EncodingTable::new(encoding);
            for code in 0..=255 {
                assert_eq!(table.code(table.light(code)), code, "{encoding:?}");
            }
            let mut lights = [0.0; 256];
            let codes: Vec<u8> = (0..=255).collect();
            table.lights(&codes, &mut lights).unwrap();
            assert!(lights.windows(2).all(|pair| pair[0] < pair[1]));
            assert_eq!(
                (lights[0], lights[255], lights[1]),
                (0.0, 1.0, table.light(1))
            );
            assert!(table.lights(&codes, &mut lights[1..]).is_err());
        }
    }

    #[test]
    fn known_points_of_the_curves() {
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-6, "{a} {b}");
        // IEC 61966-2-1: half of the encoded range is 21.4 % of the light.
        close(Encoding::Srgb.to_linear(0.5), 0.214_041_14);
        close(Encoding::Srgb.to_linear(0.02), 0.02 / 12.92);
        close(Encoding::Gamma22.to_linear(0.5), 0.217_637_64);
        for encoding in Encoding::ALL {
            for step in 0..=1000 {
                let value = f64::from(step) / 1000.0;
                close(encoding.from_linear(encoding.to_linear(value)), value);
            }
            close(encoding.to_linear(7.0), 1.0);
            close(encoding.from_linear(-7.0), 0.0);
        }
    }

    #[test]
    fn light_goes_to_the_nearest_code_and_never_out_of_range() {
        for encoding in Encoding::ALL {
            let table = EncodingTable::new(encoding);
            for step in 0..=5000 {
                let light = f64::from(step) / 5000.0;
                let exact = encoding.from_linear(light) * 255.0;
                assert!((f64::from(table.code(light as f32)) - exact).abs() <= 0.5 + 1e-3);
            }
            assert_eq!(
                (
                    table.code(f32::INFINITY),
                    table.code(-1.0),
                    table.code(f32::NAN)
                ),
                (255, 0, 0)
            );
        }
    }

    #[test]
    fn names_are_names() {
        for encoding in Encoding::ALL {
            assert_eq!(encoding.name().parse(), Ok(encoding));
        }
        assert_eq!("Linear".parse::<Encoding>(), Err(UnknownEncoding));
    }
}
