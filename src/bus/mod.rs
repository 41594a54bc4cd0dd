//! Shared memory between the processes: services, loans, sends, receives, liveness.
//!
//! One process owns an [`Instance`]'s services ([`Owner`]) and removes what they leave behind;
//! every other process opens them ([`Ports`]). A channel carries slices of [`Block`]s with a typed
//! header and wakes its receivers. Nothing here knows what a block means.
//!
//! [`Block`]: crate::frame::Block

mod channel;
mod instance;
mod limits;
mod owner;

pub use channel::{Header, Loan, Newest, Received, Receiver, Sender};
pub use instance::{Instance, InstanceName};
pub use limits::{ChannelLimits, Limits};
pub use owner::{Owner, Ports};

/// The transport between processes.
pub type Ipc = iceoryx2::prelude::ipc::Service;
/// The same interface within one process, without shared memory: for tests.
pub type Local = iceoryx2::prelude::local::Service;

/// Why the bus cannot do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// A name that cannot be part of a file name.
    #[error("instance name '{0}': 1 to 32 letters, digits, '-' or '_'")]
    Name(String),
    /// Another process holds the instance.
    #[error("instance '{0}' is already running (give this one another name with --instance)")]
    Running(String),
    /// No process created the services.
    #[error("instance '{instance}' has no service '{service}': is its host running?")]
    NotRunning {
        /// The instance asked for.
        instance: String,
        /// The missing service.
        service: &'static str,
    },
    /// The shared-memory file system has too little room.
    #[error("{path} has {free_mib} MiB free, the bus needs {needed_mib} MiB")]
    Room {
        /// Where shared memory lives.
        path: &'static str,
        /// Free there.
        free_mib: u64,
        /// Needed.
        needed_mib: u64,
    },
    /// Anything else the transport refuses.
    #[error("{doing}: {cause}")]
    Transport {
        /// What was being done.
        doing: &'static str,
        /// The transport's own word for it.
        cause: String,
    },
}

impl BusError {
    fn transport(doing: &'static str) -> impl Fn(&dyn std::fmt::Debug) -> Self {
        move |cause| Self::Transport {
            doing,
            cause: format!("{cause:?}"),
        }
    }
}

/// Sends the transport's own diagnostics nowhere: every error of interest comes back as a value.
pub fn silence_transport_log() {
    iceoryx2::prelude::set_log_level(iceoryx2::prelude::LogLevel::Fatal);
}
