//! Why a recording cannot be read or written.

use std::io;
use std::path::{Path, PathBuf};

use noctule_can::LineError;
use noctule_evk4::RawError;
use noctule_hesai::pcap::CaptureError;

/// A value in `meta.json`, `calib.toml` or their like that cannot be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field} = {value}: {problem}")]
pub struct FieldError {
    /// Dotted path of the field.
    pub field: String,
    /// What stands there.
    pub value: String,
    /// What is wrong with it.
    pub problem: &'static str,
}

impl FieldError {
    pub(crate) fn new(field: &str, value: impl ToString, problem: &'static str) -> Self {
        Self {
            field: field.to_owned(),
            value: value.to_string(),
            problem,
        }
    }

    /// The same, one level further down.
    pub(crate) fn within(mut self, parent: &str) -> Self {
        self.field = format!("{parent}.{}", self.field);
        self
    }
}

/// Why a recording, or a part of it, cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file could not be opened or read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file of another version of the format.
    #[error("{}: schema {found}, this program reads {supported}", path.display())]
    Schema {
        /// The file.
        path: PathBuf,
        /// What it says.
        found: u64,
        /// What can be read.
        supported: u64,
    },
    /// JSON or TOML that does not have the format's fields.
    #[error("{}:{line}: {problem}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, 1 the first.
        line: usize,
        /// What the parser said.
        problem: String,
    },
    /// A field with a value that cannot be.
    #[error("{}: {source}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// The field, the value and what is wrong.
        source: FieldError,
    },
    /// A table whose first line does not name the format's columns.
    #[error("{}:1: columns {found:?}, expected {expected:?}", path.display())]
    Columns {
        /// The file.
        path: PathBuf,
        /// First line, shortened.
        found: String,
        /// What it must say.
        expected: String,
    },
    /// A row of a table that cannot be.
    #[error("{}:{line}: {field} = {value:?}: {problem}", path.display())]
    Row {
        /// The file.
        path: PathBuf,
        /// Line, 1 being the column names.
        line: u64,
        /// The column.
        field: &'static str,
        /// What stands there, shortened.
        value: String,
        /// What is wrong with it.
        problem: &'static str,
    },
    /// A line of the CAN log that cannot be.
    #[error("{}:{line}: {source}", path.display())]
    Can {
        /// The file.
        path: PathBuf,
        /// Line, 1 the first.
        line: u64,
        /// What is wrong with it.
        source: LineError,
    },
    /// The header of the event stream cannot be understood.
    #[error("{}: {source}", path.display())]
    EventsHeader {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: RawError,
    },
    /// A capture that cannot be read on.
    #[error("{}: {source}", path.display())]
    Capture {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, and where.
        source: CaptureError,
    },
    /// A picture that cannot be decoded or is not what belongs there.
    #[error("{}: {problem}", path.display())]
    Picture {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// Something that this recording does not have was asked for.
    #[error("{}: the recording has no {what}", path.display())]
    Absent {
        /// Where it would be.
        path: PathBuf,
        /// What it is.
        what: &'static str,
    },
}

impl RecordingError {
    pub(crate) fn io(path: &Path, source: io::Error) -> Self {
        Self::Io {
            path: path.to_owned(),
            source,
        }
    }

    pub(crate) fn capture(path: &Path, source: CaptureError) -> Self {
        Self::Capture {
            path: path.to_owned(),
            source,
        }
    }

    pub(crate) fn toml(path: &Path, text: &str, error: &toml::de::Error) -> Self {
        let at = error.span().map_or(0, |span| span.start);
        Self::Syntax {
            path: path.to_owned(),
            line: text.bytes().take(at).filter(|&b| b == b'\n').count() + 1,
            problem: error.message().to_owned(),
        }
    }

    pub(crate) fn field(path: &Path, source: FieldError) -> Self {
        Self::Field {
            path: path.to_owned(),
            source,
        }
    }

    pub(crate) fn picture(path: &Path, problem: impl ToString) -> Self {
        Self::Picture {
            path: path.to_owned(),
            problem: problem.to_string(),
        }
    }
}

/// Why something cannot be written to a recording.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The file could not be created or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// There is a recording already.
    #[error("{}: exists already, a recording is never written over", path.display())]
    Exists {
        /// What is there.
        path: PathBuf,
    },
    /// A description that cannot be.
    #[error("{what}: {source}")]
    Field {
        /// `meta` or `calibration`.
        what: &'static str,
        /// The field, the value and what is wrong.
        source: FieldError,
    },
    /// Data that meta or calibration does not describe.
    #[error("{0}: neither meta nor calibration describes any")]
    Undeclared(&'static str),
    /// The event stream's header is missing, given twice, or no header.
    #[error("events header: {0}")]
    EventsHeader(String),
    /// Pixels, depths or masks that do not have the size they should.
    #[error("{what} of {width}x{height} with {actual} values, needs {needed}")]
    Size {
        /// Which picture.
        what: &'static str,
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
        /// Values the size needs.
        needed: usize,
        /// Values given.
        actual: usize,
    },
    /// A step outside `1..=steps`.
    #[error("step {step} is not in 1..={steps}")]
    Step {
        /// What was given.
        step: u32,
        /// Steps per exposure.
        steps: u32,
    },
    /// A transfer of bytes too long for the format.
    #[error("transfer of {actual} bytes, the most is {max}")]
    TransferLength {
        /// What was given.
        actual: usize,
        /// The limit.
        max: usize,
    },
}

impl WriteError {
    pub(crate) fn io(path: &Path, source: impl Into<io::Error>) -> Self {
        Self::Io {
            path: path.to_owned(),
            source: source.into(),
        }
    }
}
