//! Starts, watches and restarts a process of this program.
//!
//! A child says what it did in one line of JSON on its standard output when it ends; one that is
//! killed says nothing and is started again, a bounded number of times.

use std::io::Read;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, getppid, kill_process, set_parent_process_death_signal};
use serde::de::DeserializeOwned;

/// How often a child that dies is started again.
const RESTARTS_MAX: u32 = 5;
/// How long a child may take to end after it was asked to.
const PATIENCE: Duration = Duration::from_secs(5);

/// Why a child is not running.
#[derive(Debug, thiserror::Error)]
pub enum SuperviseError {
    /// It could not be started.
    #[error("starting '{program}': {cause}")]
    Start {
        /// What was started.
        program: PathBuf,
        /// Why it failed.
        cause: std::io::Error,
    },
    /// It ended by itself, with an error it has printed.
    #[error("'{name}' ended with {status} (its own message is above)")]
    Failed {
        /// Which child.
        name: &'static str,
        /// How it ended.
        status: ExitStatus,
    },
    /// It died too often.
    #[error("'{name}' died {deaths} times, last with {status}")]
    Dies {
        /// Which child.
        name: &'static str,
        /// How often.
        deaths: u32,
        /// How it ended last.
        status: ExitStatus,
    },
}

/// Has this process told to end (SIGTERM) when its parent `id` dies, however it dies: one that was
/// killed can tell nobody, and a child left alone would hold the instance's name.
///
/// # Errors
/// When the kernel refuses, or the parent is gone already.
pub fn end_with(id: u32) -> std::io::Result<()> {
    set_parent_process_death_signal(Some(Signal::TERM))?;
    if getppid().is_some_and(|parent| i64::from(parent.as_raw_nonzero().get()) == i64::from(id)) {
        return Ok(());
    }
    Err(std::io::Error::other(format!(
        "parent process {id} is gone"
    )))
}

/// A child process under watch. The thread that starts it must live as long as the child may: the
/// kernel takes that thread's end for the parent's.
#[derive(Debug)]
pub struct Supervised {
    name: &'static str,
    program: PathBuf,
    arguments: Vec<String>,
    child: Child,
    restarts: u32,
    reports: Vec<String>,
}

impl Supervised {
    /// Starts `program` with `arguments`.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn start(
        name: &'static str,
        program: PathBuf,
        arguments: Vec<String>,
    ) -> Result<Self, SuperviseError> {
        let child = spawn(&program, &arguments)?;
        Ok(Self {
            name,
            program,
            arguments,
            child,
            restarts: 0,
            reports: Vec::new(),
        })
    }

    /// Process id of the child that runs now.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// How often it was started again.
    #[must_use]
    pub fn restarts(&self) -> u32 {
        self.restarts
    }

    /// Looks after the child: starts it again if a signal killed it. Returns whether it did.
    ///
    /// # Errors
    /// When it ended with an error of its own, or died too often.
    pub fn watch(&mut self) -> Result<bool, SuperviseError> {
        let Ok(Some(status)) = self.child.try_wait() else {
            return Ok(false);
        };
        self.collect();
        if status.code().is_some_and(|code| code != 0) {
            return Err(SuperviseError::Failed {
                name: self.name,
                status,
            });
        }
        if self.restarts == RESTARTS_MAX {
            return Err(SuperviseError::Dies {
                name: self.name,
                deaths: RESTARTS_MAX + 1,
                status,
            });
        }
        tracing::warn!("'{}' ended with {status}, starting it again", self.name);
        self.child = spawn(&self.program, &self.arguments)?;
        self.restarts += 1;
        Ok(true)
    }

    /// Asks the child to end, makes it if it does not, and returns the reports of all its lives.
    pub fn finish<R: DeserializeOwned>(mut self) -> Vec<R> {
        self.end();
        let mut reports = Vec::new();
        for text in &self.reports {
            for line in text.lines() {
                match serde_json::from_str(line) {
                    Ok(report) => reports.push(report),
                    Err(error) => tracing::warn!("'{}' reported '{line}': {error}", self.name),
                }
            }
        }
        reports
    }

    fn end(&mut self) {
        if !matches!(self.child.try_wait(), Ok(None)) {
            self.collect();
            return;
        }
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            // One that ends at this very moment needs no signal.
            let _ = kill_process(pid, Signal::TERM);
        }
        let asked = Instant::now();
        while matches!(self.child.try_wait(), Ok(None)) {
            if asked.elapsed() > PATIENCE {
                tracing::warn!("'{}' did not end within {PATIENCE:?}: killed", self.name);
                let _ = self.child.kill();
                let _ = self.child.wait();
                break;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        self.collect();
    }

    fn collect(&mut self) {
        let mut text = String::new();
        if let Some(mut output) = self.child.stdout.take()
            && output.read_to_string(&mut text).is_ok()
            && !text.is_empty()
        {
            self.reports.push(text);
        }
    }
}

impl Drop for Supervised {
    fn drop(&mut self) {
        self.end();
    }
}

fn spawn(program: &PathBuf, arguments: &[String]) -> Result<Child, SuperviseError> {
    Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .map_err(|cause| SuperviseError::Start {
            program: program.clone(),
            cause,
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(script: &str) -> Supervised {
        Supervised::start("shell", "/bin/sh".into(), vec!["-c".into(), script.into()]).unwrap()
    }

    fn watch_until<T>(
        child: &mut Supervised,
        mut done: impl FnMut(&Result<bool, SuperviseError>) -> Option<T>,
    ) -> T {
        loop {
            let seen = child.watch();
            if let Some(value) = done(&seen) {
                return value;
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    #[test]
    fn a_child_that_ends_when_asked_hands_in_its_report() {
        let child = shell("trap 'echo 42; exit 0' TERM; while :; do sleep 0.01; done");
        std::thread::sleep(Duration::from_millis(100));
        assert_eq!(child.finish::<u32>(), [42]);
    }

    #[test]
    fn a_killed_child_is_started_again_but_not_for_ever() {
        let mut child = shell("kill -KILL $$");
        let deaths = watch_until(&mut child, |seen| match seen {
            Err(SuperviseError::Dies { deaths, .. }) => Some(*deaths),
            _ => None,
        });
        assert_eq!((deaths, child.restarts()), (RESTARTS_MAX + 1, RESTARTS_MAX));
    }

    #[test]
    fn a_child_that_fails_by_itself_is_not_started_again() {
        let mut child = shell("exit 3");
        let failed = watch_until(&mut child, |seen| {
            seen.as_ref()
                .err()
                .map(|e| matches!(e, SuperviseError::Failed { .. }))
        });
        assert!(failed);
    }
}
