//! A program that was started: its children, signals to it, its end.

use std::fs;
use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process, kill_process_group};

/// How long anything may take before a test gives up on it.
const PATIENCE: Duration = Duration::from_secs(60);
const LOOK: Duration = Duration::from_millis(5);

/// A process in a process group of its own, as a terminal starts it; killed when dropped.
#[derive(Debug)]
pub struct Started {
    child: Child,
    outputs: Option<[JoinHandle<String>; 2]>,
}

/// How a process ended.
#[derive(Debug)]
pub struct Ended {
    /// Exit code; `None` when a signal killed it.
    pub code: Option<i32>,
    /// Standard output.
    pub stdout: String,
    /// Standard error.
    pub stderr: String,
}

impl Ended {
    /// The JSON object it printed.
    ///
    /// # Panics
    /// When its last line is none.
    #[must_use]
    pub fn report(&self) -> serde_json::Value {
        let line = self.stdout.lines().last().unwrap_or_default();
        serde_json::from_str(line)
            .unwrap_or_else(|e| panic!("{e} in '{line}'; standard error: {}", self.stderr))
    }
}

impl Started {
    /// Starts `command`.
    ///
    /// # Panics
    /// When it cannot be started.
    #[must_use]
    pub fn new(command: &mut Command) -> Self {
        use std::os::unix::process::CommandExt as _;
        let mut child = command
            .process_group(0)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (out, err) = (child.stdout.take().unwrap(), child.stderr.take().unwrap());
        Self {
            child,
            outputs: Some([read_all(out), read_all(err)]),
        }
    }

    fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// Sends a signal to this process alone.
    pub fn signal(&self, signal: Signal) {
        // One that has ended already needs none.
        let _ = kill_process(self.pid(), signal);
    }

    /// What Ctrl-C in a terminal does: SIGINT to the whole group, children included.
    pub fn ctrl_c(&self) {
        let _ = kill_process_group(self.pid(), Signal::INT);
    }

    /// The child process whose first argument is `argument`, waited for.
    ///
    /// # Panics
    /// When there is none within a minute, or this process ends meanwhile.
    pub fn child_of_name(&mut self, argument: &str) -> Pid {
        let asked = Instant::now();
        loop {
            if let Some(found) = children(self.pid())
                .into_iter()
                .find(|&c| runs(c, argument))
            {
                return found;
            }
            let ended = self.child.try_wait().unwrap();
            assert!(
                ended.is_none(),
                "ended with {ended:?} before it had a child '{argument}'"
            );
            assert!(
                asked.elapsed() < PATIENCE,
                "no child '{argument}' within {PATIENCE:?}"
            );
            thread::sleep(LOOK);
        }
    }

    /// Waits for its end.
    ///
    /// # Panics
    /// When it has not ended after `limit`.
    #[must_use]
    pub fn wait_at_most(mut self, limit: Duration) -> Ended {
        let asked = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            assert!(asked.elapsed() < limit, "still running after {limit:?}");
            thread::sleep(LOOK);
        };
        let [stdout, stderr] = self
            .outputs
            .take()
            .unwrap()
            .map(|reader| reader.join().unwrap());
        Ended {
            code: status.code(),
            stdout,
            stderr,
        }
    }

    /// Waits for its end, however long a loaded machine takes (within reason).
    #[must_use]
    pub fn wait(self) -> Ended {
        self.wait_at_most(PATIENCE)
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            let _ = kill_process_group(self.pid(), Signal::KILL);
            let _ = self.child.wait();
        }
    }
}

/// Waits until no process of this id is left.
///
/// # Panics
/// When it is there after a minute.
pub fn wait_until_gone(pid: Pid) {
    let asked = Instant::now();
    while is_alive(pid) {
        assert!(asked.elapsed() < PATIENCE, "process {pid:?} is still there");
        thread::sleep(LOOK);
    }
}

/// A zombie that nobody has waited for counts as gone.
fn is_alive(pid: Pid) -> bool {
    let stat = fs::read_to_string(format!("/proc/{}/stat", pid.as_raw_nonzero()));
    stat.is_ok_and(|stat| !stat.rsplit(") ").next().unwrap_or("Z").starts_with('Z'))
}

/// Children of any of the process's threads.
fn children(parent: Pid) -> Vec<Pid> {
    let threads = fs::read_dir(format!("/proc/{}/task", parent.as_raw_nonzero()));
    let mut found = Vec::new();
    for thread in threads.into_iter().flatten().flatten() {
        let list = fs::read_to_string(thread.path().join("children")).unwrap_or_default();
        found.extend(
            list.split_whitespace()
                .filter_map(|id| Pid::from_raw(id.parse().ok()?)),
        );
    }
    found
}

fn runs(pid: Pid, argument: &str) -> bool {
    let line = fs::read(format!("/proc/{}/cmdline", pid.as_raw_nonzero())).unwrap_or_default();
    line.split(|&b| b == 0).nth(1) == Some(argument.as_bytes())
}

fn read_all(mut from: impl Read + Send + 'static) -> JoinHandle<String> {
    thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = from.read_to_end(&mut bytes);
        String::from_utf8_lossy(&bytes).into_owned()
    })
}
