//! Comma-separated tables of plain numbers and words: one line per row, no quoting, a first line
//! that names the columns.

use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::{RecordingError, WriteError};

/// Longest line understood, bytes; longer ones are refused without reading them whole.
const LINE_LEN_MAX: u64 = 4096;

/// One line, and where it stands.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Line<'a> {
    pub(crate) path: &'a Path,
    /// 1 the first.
    pub(crate) number: u64,
    pub(crate) text: &'a str,
}

/// Reads lines into one buffer, and tells a cut last line from a whole one.
#[derive(Debug)]
pub(crate) struct Lines {
    path: PathBuf,
    reader: BufReader<File>,
    buffer: Vec<u8>,
    number: u64,
    truncated: u64,
}

impl Lines {
    pub(crate) fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = File::open(path).map_err(|e| RecordingError::io(path, e))?;
        Ok(Self {
            path: path.to_owned(),
            reader: BufReader::with_capacity(64 << 10, file),
            buffer: Vec::with_capacity(256),
            number: 0,
            truncated: 0,
        })
    }

    /// Last lines that were cut off, and not handed over.
    pub(crate) const fn truncated(&self) -> u64 {
        self.truncated
    }

    /// The next whole line without its end. A last line without an end was cut off while it was
    /// written: any of its numbers may be short, so it is counted and not handed over.
    pub(crate) fn next_line(&mut self) -> Result<Option<Line<'_>>, RecordingError> {
        self.buffer.clear();
        let mut limited = (&mut self.reader).take(LINE_LEN_MAX);
        limited
            .read_until(b'\n', &mut self.buffer)
            .map_err(|e| RecordingError::io(&self.path, e))?;
        if self.buffer.is_empty() {
            return Ok(None);
        }
        if self.buffer.pop_if(|last| *last == b'\n').is_none() {
            if self.buffer.len() as u64 == LINE_LEN_MAX {
                self.number += 1;
                return Err(self.error("line", "", "longer than 4096 bytes"));
            }
            self.truncated += 1;
            return Ok(None);
        }
        self.buffer.pop_if(|last| *last == b'\r');
        self.number += 1;
        match std::str::from_utf8(&self.buffer) {
            Ok(text) => Ok(Some(Line {
                path: &self.path,
                number: self.number,
                text,
            })),
            Err(_) => {
                let lossy = String::from_utf8_lossy(&self.buffer).into_owned();
                Err(self.error("line", &lossy, "not utf-8"))
            }
        }
    }

    fn error(&self, field: &'static str, value: &str, problem: &'static str) -> RecordingError {
        row_error(&self.path, self.number, field, value, problem)
    }
}

fn row_error(
    path: &Path,
    line: u64,
    field: &'static str,
    value: &str,
    problem: &'static str,
) -> RecordingError {
    RecordingError::Row {
        path: path.to_owned(),
        line,
        field,
        value: value.chars().take(60).collect(),
        problem,
    }
}

/// Reads a table whose columns are known.
#[derive(Debug)]
pub(crate) struct Table {
    lines: Lines,
    columns: &'static [&'static str],
}

impl Table {
    /// Opens a table and checks that its first line names exactly `columns`.
    pub(crate) fn open(
        path: &Path,
        columns: &'static [&'static str],
    ) -> Result<Self, RecordingError> {
        let mut lines = Lines::open(path)?;
        let expected = columns.join(",");
        let found = lines.next_line()?.map_or("", |line| line.text);
        if found != expected {
            return Err(RecordingError::Columns {
                path: path.to_owned(),
                found: found.chars().take(200).collect(),
                expected,
            });
        }
        Ok(Self { lines, columns })
    }

    /// Last rows that were cut off.
    pub(crate) const fn truncated(&self) -> u64 {
        self.lines.truncated()
    }

    /// The next row; `None` at the end or at a row that was cut off.
    pub(crate) fn next_row(&mut self) -> Result<Option<Row<'_>>, RecordingError> {
        let columns = self.columns;
        let Some(line) = self.lines.next_line()? else {
            return Ok(None);
        };
        if line.text.split(',').count() != columns.len() {
            let problem = "has not as many fields as there are columns";
            return Err(row_error(line.path, line.number, "row", line.text, problem));
        }
        Ok(Some(Row { line, columns }))
    }
}

/// One row of a [`Table`].
pub(crate) struct Row<'a> {
    line: Line<'a>,
    columns: &'static [&'static str],
}

impl Row<'_> {
    /// The text of a column.
    pub(crate) fn text(&self, column: usize) -> &str {
        self.line.text.split(',').nth(column).unwrap_or_default()
    }

    /// A column as a number or whatever else reads from text.
    pub(crate) fn get<T: FromStr>(&self, column: usize) -> Result<T, RecordingError> {
        let text = self.text(column);
        text.parse()
            .map_err(|_| self.error(column, "not a number of its range"))
    }

    /// As [`get`](Self::get); an empty field is `None`.
    pub(crate) fn optional<T: FromStr>(&self, column: usize) -> Result<Option<T>, RecordingError> {
        if self.text(column).is_empty() {
            return Ok(None);
        }
        self.get(column).map(Some)
    }

    /// An error about a column.
    pub(crate) fn error(&self, column: usize, problem: &'static str) -> RecordingError {
        let field = self.columns[column];
        let Line { path, number, .. } = self.line;
        row_error(path, number, field, self.text(column), problem)
    }
}

/// A buffered file that names itself in errors.
#[derive(Debug)]
pub(crate) struct OutFile {
    path: PathBuf,
    writer: BufWriter<File>,
}

impl OutFile {
    pub(crate) fn create(path: PathBuf, buffer_len: usize) -> Result<Self, WriteError> {
        let file = File::create_new(&path).map_err(|e| WriteError::io(&path, e))?;
        Ok(Self {
            path,
            writer: BufWriter::with_capacity(buffer_len, file),
        })
    }

    /// A new table with its first line.
    pub(crate) fn table(path: PathBuf, columns: &[&str]) -> Result<Self, WriteError> {
        let mut file = Self::create(path, 64 << 10)?;
        file.line(format_args!("{}", columns.join(",")))?;
        // Whatever happens from here on, the table can be opened.
        file.flush()?;
        Ok(file)
    }

    pub(crate) fn bytes(&mut self, bytes: &[u8]) -> Result<(), WriteError> {
        let Self { path, writer } = self;
        writer.write_all(bytes).map_err(|e| WriteError::io(path, e))
    }

    pub(crate) fn line(&mut self, text: std::fmt::Arguments<'_>) -> Result<(), WriteError> {
        let Self { path, writer } = self;
        writeln!(writer, "{text}").map_err(|e| WriteError::io(path, e))
    }

    pub(crate) fn flush(&mut self) -> Result<(), WriteError> {
        let Self { path, writer } = self;
        writer.flush().map_err(|e| WriteError::io(path, e))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const COLUMNS: &[&str] = &["a", "b"];

    type Rows = Vec<(u64, Option<i32>)>;

    /// Reads every row as a number and an optional number; also gives the count of cut rows.
    fn read(bytes: &[u8]) -> (Result<Rows, RecordingError>, u64) {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        let mut table = match Table::open(file.path(), COLUMNS) {
            Ok(table) => table,
            Err(error) => return (Err(error), 0),
        };
        let mut rows = Vec::new();
        let mut read = || {
            while let Some(row) = table.next_row()? {
                rows.push((row.get(0)?, row.optional(1)?));
            }
            Ok(())
        };
        let result = read();
        (result.map(|()| rows), table.truncated())
    }

    #[test]
    fn carriage_returns_and_empty_fields_are_read() {
        let (rows, truncated) = read(b"a,b\r\n1,\r\n2,-3\n");
        assert_eq!(rows.unwrap(), [(1, None), (2, Some(-3))]);
        assert_eq!(truncated, 0);
    }

    #[test]
    fn an_empty_field_where_a_number_must_be_is_located() {
        let text = read(b"a,b\n1,2\n,3\n").0.unwrap_err().to_string();
        assert!(
            text.ends_with(":3: a = \"\": not a number of its range"),
            "{text}"
        );
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// However a table is cut, whole rows are read and a partial one is counted.
        #[test]
        fn every_cut_keeps_the_whole_rows(
            rows: Vec<(u64, Option<i32>)>, cut in any::<prop::sample::Index>(),
        ) {
            let mut text = "a,b\n".to_owned();
            for (a, b) in &rows {
                let b = b.map_or(String::new(), |b| b.to_string());
                text.push_str(&format!("{a},{b}\n"));
            }
            let at = 4 + cut.index(text.len() - 3);
            let whole = text[4..at].matches('\n').count();
            let (result, truncated) = read(&text.as_bytes()[..at]);
            prop_assert_eq!(result.unwrap(), &rows[..whole]);
            prop_assert_eq!(truncated, u64::from(!text[..at].ends_with('\n')));
        }

        #[test]
        fn no_bytes_panic(bytes: Vec<u8>, near in "a,b\n([0-9,\\-]{0,6}\n){0,4}") {
            let _ = read(&bytes);
            let _ = read(near.as_bytes());
        }
    }
}
