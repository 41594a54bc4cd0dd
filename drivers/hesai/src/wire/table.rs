//! Per-channel tables as text: one line per laser, as the sensor and its vendor hand them out.

use thiserror::Error;

/// What is wrong with a correction or fire-time table.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum TableError {
    /// A line that is no row of numbers.
    #[error("line {line}: field {field} is {text:?}, needs a number")]
    Number {
        /// 1-based.
        line: usize,
        /// 1-based.
        field: usize,
        /// What stands there, cut to 40 characters.
        text: String,
    },
    /// A row with another number of fields.
    #[error("line {line}: {found} fields, needs {needed}")]
    Fields {
        /// 1-based.
        line: usize,
        /// Fields a row has.
        needed: usize,
        /// Fields this one has.
        found: usize,
    },
    /// A channel the model does not have.
    #[error("line {line}: channel {channel}, needs 1 to {channels}")]
    Channel {
        /// 1-based.
        line: usize,
        /// What it says.
        channel: f64,
        /// Lasers of the model.
        channels: usize,
    },
    /// A channel that an earlier line has given already.
    #[error("line {line}: channel {channel} was given before")]
    Repeated {
        /// 1-based.
        line: usize,
        /// 1-based.
        channel: usize,
    },
    /// A value no laser can have.
    #[error("line {line}: {what} {value} is outside {min} to {max}")]
    Range {
        /// 1-based.
        line: usize,
        /// Name of the column and its unit.
        what: &'static str,
        /// What it says.
        value: f64,
        /// Least value allowed.
        min: f64,
        /// Greatest value allowed.
        max: f64,
    },
    /// The text ends before every channel has its row.
    #[error("channel {channel} has no row; {found} of {channels} are there")]
    Missing {
        /// The first that is missing, 1-based.
        channel: usize,
        /// Rows found.
        found: usize,
        /// Lasers of the model.
        channels: usize,
    },
}

/// A column beside the channel's number: what it holds and between which bounds.
pub(super) struct Column {
    pub what: &'static str,
    pub min: f64,
    pub max: f64,
}

/// Reads `channels` rows of channel number (from 1, any order) and one value per column.
///
/// Allowed besides: header and unit lines before the first row, empty lines, `#` comments, a byte
/// order mark, and, once all rows are there, anything (the sensor appends a hash line). Fields are
/// separated by commas, semicolons, tabs or blanks.
pub(super) fn parse<const N: usize>(
    text: &str,
    channels: usize,
    columns: &[Column; N],
) -> Result<Vec<[f64; N]>, TableError> {
    let mut rows: Vec<Option<[f64; N]>> = vec![None; channels];
    let mut found = 0;
    for (index, raw) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let line = index + 1;
        let content = raw.trim();
        if content.is_empty() || content.starts_with('#') {
            continue;
        }
        let fields: Vec<&str> = split(content);
        if fields[0].parse::<f64>().is_err() && (found == 0 || found == channels) {
            continue;
        }
        let (channel, values) = row(line, &fields, channels, columns)?;
        if rows[channel - 1].replace(values).is_some() {
            return Err(TableError::Repeated { line, channel });
        }
        found += 1;
    }
    let missing = rows.iter().position(Option::is_none);
    if let Some(index) = missing {
        return Err(TableError::Missing {
            channel: index + 1,
            found,
            channels,
        });
    }
    Ok(rows.into_iter().flatten().collect())
}

fn split(line: &str) -> Vec<&str> {
    if line.contains([',', ';', '\t']) {
        // A trailing separator is how some spreadsheets end their rows.
        let line = line.trim_end_matches([',', ';', '\t']);
        line.split([',', ';', '\t']).map(str::trim).collect()
    } else {
        line.split_whitespace().collect()
    }
}

fn row<const N: usize>(
    line: usize,
    fields: &[&str],
    channels: usize,
    columns: &[Column; N],
) -> Result<(usize, [f64; N]), TableError> {
    if fields.len() != N + 1 {
        return Err(TableError::Fields {
            line,
            needed: N + 1,
            found: fields.len(),
        });
    }
    let number = |field: usize| {
        let text = fields[field];
        text.parse::<f64>()
            .ok()
            .filter(|v| v.is_finite())
            .ok_or_else(|| TableError::Number {
                line,
                field: field + 1,
                text: text.chars().take(40).collect(),
            })
    };
    let first = number(0)?;
    let channel =
        (1..=channels)
            .find(|&c| fields[0].parse() == Ok(c))
            .ok_or(TableError::Channel {
                line,
                channel: first,
                channels,
            })?;
    let mut values = [0.0; N];
    for (index, (value, column)) in values.iter_mut().zip(columns).enumerate() {
        *value = number(index + 1)?;
        let &Column { what, min, max } = column;
        if !(min..=max).contains(value) {
            return Err(TableError::Range {
                line,
                what,
                value: *value,
                min,
                max,
            });
        }
    }
    Ok((channel, values))
}

#[cfg(test)]
mod tests {
    use super::*;

    const COLUMNS: [Column; 1] = [Column {
        what: "angle in degrees",
        min: -90.0,
        max: 90.0,
    }];

    fn parse3(text: &str) -> Result<Vec<[f64; 1]>, TableError> {
        parse(text, 3, &COLUMNS)
    }

    #[test]
    fn headers_units_comments_and_hashes_are_not_rows() {
        let plain = parse3("1,0.5\n2,1.5\n3,-2\n").unwrap();
        assert_eq!(plain, [[0.5], [1.5], [-2.0]]);
        let decorated = "\u{feff}EEFF,1,1\r\nLaser id,Elevation\r\n\r\n# unit: degree\r\n\
                         3;-2\r\n 1\t0.5\r\n2 1.5\r\n5f2c9a,\r\n";
        assert_eq!(parse3(decorated).unwrap(), plain);
        assert_eq!(parse3("1,0.5,\n2,1.5,\n3,-2,").unwrap(), plain);
    }

    #[test]
    fn every_fault_is_located() {
        use TableError::{Channel, Fields, Missing, Number, Range, Repeated};
        let is = |text, error| assert_eq!(parse3(text), Err(error), "{text:?}");
        is(
            "h\n1,x\n",
            Number {
                line: 2,
                field: 2,
                text: "x".into(),
            },
        );
        is(
            "1,NaN\n",
            Number {
                line: 1,
                field: 2,
                text: "NaN".into(),
            },
        );
        is(
            "1,0\nabc,1\n",
            Number {
                line: 2,
                field: 1,
                text: "abc".into(),
            },
        );
        is(
            "1,0,0\n",
            Fields {
                line: 1,
                needed: 2,
                found: 3,
            },
        );
        is(
            "0,1\n",
            Channel {
                line: 1,
                channel: 0.0,
                channels: 3,
            },
        );
        is(
            "1.5,1\n",
            Channel {
                line: 1,
                channel: 1.5,
                channels: 3,
            },
        );
        is(
            "1,1\n1,1\n",
            Repeated {
                line: 2,
                channel: 1,
            },
        );
        let what = "angle in degrees";
        is(
            "1,91\n",
            Range {
                line: 1,
                what,
                value: 91.0,
                min: -90.0,
                max: 90.0,
            },
        );
        is(
            "1,1\n3,1\n",
            Missing {
                channel: 2,
                found: 2,
                channels: 3,
            },
        );
        is(
            "",
            Missing {
                channel: 1,
                found: 0,
                channels: 3,
            },
        );
        is(
            "1,1\n2,1\n3,1\n4,1\n",
            Channel {
                line: 4,
                channel: 4.0,
                channels: 3,
            },
        );
    }
}
