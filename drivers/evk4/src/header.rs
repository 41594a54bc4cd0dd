//! The text in front of a RAW file: which encoding follows, and for what sensor.
//!
//! Both styles are read: closed by `% end`, and the older one that ends at the first line that is
//! not a printable `%` line. A payload may itself begin with a percent sign.

use crate::{Format, Geometry};

/// Header lines longer than this are taken for payload.
const LINE_LEN_MAX: usize = 4096;

/// What a RAW file says about itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawHeader {
    /// Encoding of the payload.
    pub format: Format,
    /// Size of the sensor.
    pub geometry: Geometry,
    /// Every `key value` line, in file order, without the closing `end`.
    pub fields: Vec<(String, String)>,
}

/// Why a header could not be understood.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RawError {
    /// The file does not begin with a header line.
    #[error("no raw header: file begins with {0:02x?}, not with a \"%\" line")]
    NoHeader(Vec<u8>),
    /// Neither `evt` nor `format` is there, and the system is not a known one.
    #[error("raw header names no encoding: neither \"format\" nor \"evt\", system_ID {0:?}")]
    FormatMissing(Option<String>),
    /// An encoding that cannot be decoded.
    #[error("raw header names an unknown encoding {0:?}")]
    FormatUnknown(String),
    /// A size that is not two positive numbers.
    #[error("raw header gives the geometry as {0:?}")]
    GeometryInvalid(String),
    /// No size in the header, and none known for the system.
    #[error(
        "raw header gives no geometry, and none is known for system_ID {system_id:?}, \
         plugin {plugin:?}"
    )]
    GeometryMissing {
        /// `system_ID` of the header.
        system_id: Option<String>,
        /// `plugin_name` of the header.
        plugin: Option<String>,
    },
}

impl RawHeader {
    /// A header for a file about to be written.
    #[must_use]
    pub const fn new(format: Format, geometry: Geometry) -> Self {
        Self {
            format,
            geometry,
            fields: Vec::new(),
        }
    }

    /// Reads the header at the start of `bytes`, and says where the payload begins.
    ///
    /// # Errors
    /// When there is no header, or it does not give encoding and sensor size even by way of the
    /// system it names.
    pub fn parse(bytes: &[u8]) -> Result<(Self, usize), RawError> {
        Self::parse_with(bytes, None)
    }

    /// As [`parse`](Self::parse), with a sensor size for headers that give none.
    ///
    /// # Errors
    /// As [`parse`](Self::parse).
    pub fn parse_with(bytes: &[u8], fallback: Option<Geometry>) -> Result<(Self, usize), RawError> {
        let payload = payload_offset(bytes);
        if payload == 0 {
            return Err(RawError::NoHeader(bytes[..bytes.len().min(8)].to_vec()));
        }
        let fields = fields(&bytes[..payload]);
        let format = find_format(&fields)?;
        let geometry = find_geometry(&fields, fallback)?;
        let header = Self {
            format,
            geometry,
            fields,
        };
        Ok((header, payload))
    }

    /// The last value given for `key`.
    #[must_use]
    pub fn field(&self, key: &str) -> Option<&str> {
        get(&self.fields, key)
    }

    /// The header as text, closed by `% end`: encoding and size from the typed members, then all
    /// other fields.
    ///
    /// Keys and values are written on one line: line breaks in them become spaces.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let Geometry { width, height } = self.geometry;
        let (evt, name) = match self.format {
            Format::Evt2 => ("2.0", "EVT2"),
            Format::Evt21 => ("2.1", "EVT21;endianness=little"),
            Format::Evt21Legacy => ("2.1", "EVT21;endianness=legacy"),
            Format::Evt3 => ("3.0", "EVT3"),
        };
        let mut text = format!(
            "% evt {evt}\n% format {name};height={height};width={width}\n\
             % geometry {width}x{height}\n"
        );
        for (key, value) in &self.fields {
            if matches!(
                key.as_str(),
                "evt" | "format" | "geometry" | "endianness" | "end" | ""
            ) {
                continue;
            }
            let line = format!("% {key} {value}").replace(['\n', '\r'], " ");
            text.push_str(line.trim_end());
            text.push('\n');
        }
        text.push_str("% end\n");
        text.into_bytes()
    }
}

/// Length of the header at the start of `bytes`; 0 when there is none.
fn payload_offset(bytes: &[u8]) -> usize {
    // A closing line settles it: text before it need not be printable.
    let mut offset = 0;
    while let Some(line) = line_at(bytes, offset) {
        offset += line.len();
        if line[1..].trim_ascii() == b"end" {
            return offset;
        }
    }
    offset = 0;
    while let Some(line) = line_at(bytes, offset) {
        let printable = |b: &u8| (b' '..=b'~').contains(b) || matches!(b, b'\t' | b'\r' | b'\n');
        if !line.iter().all(printable) {
            break;
        }
        offset += line.len();
    }
    offset
}

/// The `%` line that starts at `offset`, with its line feed.
fn line_at(bytes: &[u8], offset: usize) -> Option<&[u8]> {
    let rest = &bytes[offset..];
    if rest.first() != Some(&b'%') {
        return None;
    }
    let window = &rest[..rest.len().min(LINE_LEN_MAX)];
    let end = window.iter().position(|&b| b == b'\n')?;
    Some(&rest[..=end])
}

fn fields(header: &[u8]) -> Vec<(String, String)> {
    let text = String::from_utf8_lossy(header);
    text.lines()
        .map(|line| line.trim_start_matches('%').trim())
        .filter(|line| !line.is_empty() && *line != "end")
        .map(|line| {
            let (key, value) = line.split_once([' ', '\t']).unwrap_or((line, ""));
            (key.to_owned(), value.trim().to_owned())
        })
        .collect()
}

fn get<'a>(fields: &'a [(String, String)], key: &str) -> Option<&'a str> {
    let found = fields.iter().rev().find(|(k, _)| k == key);
    found.map(|(_, value)| value.as_str())
}

/// The value of `name=value` among the options of the `format` field.
fn format_option<'a>(fields: &'a [(String, String)], name: &str) -> Option<&'a str> {
    let options = get(fields, "format")?.split(';').skip(1);
    let mut pairs = options.filter_map(|option| option.split_once('='));
    pairs
        .find(|(key, _)| key.trim() == name)
        .map(|(_, value)| value.trim())
}

fn find_format(fields: &[(String, String)]) -> Result<Format, RawError> {
    if let Some(format) = get(fields, "format") {
        let name = format.split(';').next().unwrap_or("").trim();
        return match name {
            "EVT2" => Ok(Format::Evt2),
            "EVT21" => Ok(evt21(fields)),
            "EVT3" => Ok(Format::Evt3),
            _ => Err(RawError::FormatUnknown(format.to_owned())),
        };
    }
    match get(fields, "evt") {
        Some("2" | "2.0") => Ok(Format::Evt2),
        Some("2.1") => Ok(evt21(fields)),
        Some("3" | "3.0") => Ok(Format::Evt3),
        Some(evt) => Err(RawError::FormatUnknown(format!("evt {evt}"))),
        None => known_system(fields)
            .map(|(format, _)| format)
            .ok_or_else(|| RawError::FormatMissing(get(fields, "system_ID").map(str::to_owned))),
    }
}

/// The word order of EVT 2.1: stated, or "legacy" for systems older than 0x37, the first one
/// with plain little-endian words (OpenEB, `psee_raw_file_header.cpp`).
fn evt21(fields: &[(String, String)]) -> Format {
    const FIRST_LITTLE_ENDIAN: u32 = 0x37;
    let stated = format_option(fields, "endianness").or_else(|| get(fields, "endianness"));
    let legacy = match stated {
        Some(order) => order == "legacy",
        None => system_id(fields).is_some_and(|id| (1..FIRST_LITTLE_ENDIAN).contains(&id)),
    };
    if legacy {
        Format::Evt21Legacy
    } else {
        Format::Evt21
    }
}

fn find_geometry(
    fields: &[(String, String)],
    fallback: Option<Geometry>,
) -> Result<Geometry, RawError> {
    let options = (
        format_option(fields, "width"),
        format_option(fields, "height"),
    );
    if let (Some(width), Some(height)) = options {
        return geometry(width, height)
            .ok_or_else(|| RawError::GeometryInvalid(format!("{width}x{height}")));
    }
    if let Some(size) = get(fields, "geometry") {
        let (width, height) = size.split_once('x').unwrap_or((size, ""));
        return geometry(width, height).ok_or_else(|| RawError::GeometryInvalid(size.to_owned()));
    }
    known_system(fields)
        .map(|(_, geometry)| geometry)
        .or_else(|| known_name(fields))
        .or(fallback)
        .ok_or_else(|| RawError::GeometryMissing {
            system_id: get(fields, "system_ID").map(str::to_owned),
            plugin: get(fields, "plugin_name").map(str::to_owned),
        })
}

fn geometry(width: &str, height: &str) -> Option<Geometry> {
    let side = |text: &str| text.trim().parse::<u16>().ok().filter(|&n| n > 0);
    Some(Geometry {
        width: side(width)?,
        height: side(height)?,
    })
}

const VGA: Geometry = Geometry {
    width: 640,
    height: 480,
};
const HD: Geometry = Geometry {
    width: 1280,
    height: 720,
};

/// Size by sensor name, in plug-in names and sensor fields (`hal_plugin_gen41_evk3`, `IMX636`).
const SENSOR_NAMES: [(&str, Geometry); 4] =
    [("gen3", VGA), ("gen4", HD), ("imx636", HD), ("imx646", HD)];

fn known_name(fields: &[(String, String)]) -> Option<Geometry> {
    let named = [
        "plugin_name",
        "sensor_name",
        "sensor_generation",
        "generation",
    ]
    .iter()
    .find_map(|key| {
        let value = get(fields, key)?.to_lowercase();
        let by_name = SENSOR_NAMES.iter().find(|(name, _)| value.contains(name));
        by_name.map(|&(_, geometry)| geometry)
    });
    let generation = get(fields, "sensor_generation").or_else(|| get(fields, "generation"));
    named.or_else(|| match generation?.split('.').next()? {
        "3" => Some(VGA),
        "4" => Some(HD),
        _ => None,
    })
}

fn system_id(fields: &[(String, String)]) -> Option<u32> {
    get(fields, "system_ID")?.parse().ok()
}

/// Encoding and size by `system_ID` (OpenEB, `device_system_id.h` and `psee_raw_file_header.cpp`).
fn known_system(fields: &[(String, String)]) -> Option<(Format, Geometry)> {
    match system_id(fields)? {
        0x15 | 0x17 | 0x19 | 0x1C | 0x1D | 0x21 | 0x22 | 0x23 | 0x29 => Some((Format::Evt2, VGA)),
        0x28 => Some((Format::Evt3, VGA)),
        0x1A | 0x1F | 0x27 => Some((Format::Evt2, HD)),
        0x1E | 0x2E | 0x30 | 0x31 | 0x32 => Some((Format::Evt3, HD)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<(RawHeader, usize), RawError> {
        RawHeader::parse(text.as_bytes())
    }

    #[test]
    fn what_is_written_is_read_again() {
        for format in [
            Format::Evt2,
            Format::Evt21,
            Format::Evt21Legacy,
            Format::Evt3,
        ] {
            let mut header = RawHeader::new(format, VGA);
            header.fields.push(("serial_number".into(), "00 17".into()));
            header.fields.push(("evt".into(), "9.9".into()));
            header.fields.push(("note".into(), "two\nlines".into()));
            let mut bytes = header.to_bytes();
            let len = bytes.len();
            bytes.extend_from_slice(b"% not a header line\n");
            let (read, payload) = RawHeader::parse(&bytes).unwrap();
            assert_eq!((read.format, read.geometry, payload), (format, VGA, len));
            assert_eq!(read.field("serial_number"), Some("00 17"));
            assert_eq!(read.field("note"), Some("two lines"));
            assert_eq!(read.to_bytes(), bytes[..len]);
        }
    }

    #[test]
    fn an_old_header_ends_at_the_first_line_that_is_not_printable() {
        let header = b"% evt 2.0\n% system_ID 21\n";
        for payload in [
            &b"\x01\x02\n"[..],
            b"%\x80\x01\n%",
            b"% no line feed",
            b"",
            b"%",
        ] {
            let bytes = [header, payload].concat();
            let (read, offset) = RawHeader::parse(&bytes).unwrap();
            assert_eq!(offset, header.len(), "{payload:?}");
            assert_eq!((read.format, read.geometry), (Format::Evt2, VGA));
        }
    }

    #[test]
    fn a_closing_line_settles_the_end_whatever_is_around_it() {
        let text = "% integrator_name Hochschule Z\u{fc}rich\r\n% format EVT3;width=9;height=7\r\n% end\r\n%a\n";
        let (read, offset) = parse(text).unwrap();
        assert_eq!(&text.as_bytes()[offset..], b"%a\n");
        assert_eq!(
            read.geometry,
            Geometry {
                width: 9,
                height: 7
            }
        );
        assert_eq!(
            read.field("integrator_name"),
            Some("Hochschule Z\u{fc}rich")
        );
    }

    #[test]
    fn format_wins_and_endianness_is_found_wherever_it_is() {
        let size = "% geometry 320x320\n";
        for (lines, format) in [
            ("% evt 2.0\n% format EVT3\n", Format::Evt3),
            ("% format EVT21;endianness=legacy\n", Format::Evt21Legacy),
            ("% format EVT21\n% endianness legacy\n", Format::Evt21Legacy),
            (
                "% format EVT21;endianness=little\n% system_ID 49\n",
                Format::Evt21,
            ),
            ("% evt 2.1\n% system_ID 49\n", Format::Evt21Legacy),
            ("% evt 2.1\n% system_ID 55\n", Format::Evt21),
            ("% evt 2.1\n", Format::Evt21),
            ("% system_ID 48\n", Format::Evt3),
        ] {
            let (read, _) = parse(&format!("{lines}{size}")).unwrap();
            assert_eq!(read.format, format, "{lines}");
            assert_eq!(
                (read.geometry.width, read.geometry.height),
                (320, 320),
                "{lines}"
            );
        }
    }

    #[test]
    fn size_falls_back_on_system_then_name_then_caller() {
        for (line, size) in [
            ("% system_ID 49\n", HD),
            ("% system_ID 40\n", VGA),
            ("% plugin_name hal_plugin_gen31_fx3\n", VGA),
            ("% plugin_name hal_plugin_imx636_evk4\n", HD),
            ("% sensor_generation 4.2\n", HD),
        ] {
            let text = format!("% evt 3.0\n{line}");
            let (read, _) = RawHeader::parse_with(text.as_bytes(), Some(HD)).unwrap();
            assert_eq!(read.geometry, size, "{line}");
        }
        let bare = b"% evt 3.0\n% system_ID 999\n";
        let (read, _) = RawHeader::parse_with(bare, Some(VGA)).unwrap();
        assert_eq!(read.geometry, VGA);
        let error = RawHeader::parse(bare).unwrap_err();
        assert!(error.to_string().contains("\"999\""), "{error}");
    }

    #[test]
    fn bad_headers_say_what_is_wrong() {
        for (text, part) in [
            ("", "begins with []"),
            ("\u{1}abc", "begins with [01, 61"),
            ("% Date today\n", "system_ID None"),
            ("% evt 4.0\n", "evt 4.0"),
            ("% format EVT4;width=1;height=1\n", "EVT4"),
            ("% format EVT3;width=0;height=720\n", "0x720"),
            ("% evt 3.0\n% geometry 1280\n", "\"1280\""),
            ("% evt 3.0\n% geometry 70000x2\n", "70000x2"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(part), "{text:?}: {error}");
        }
    }
}
