//! Where the program under test is.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// The `noctule` binary of the profile that this test was built with. `cargo test` of the whole
/// workspace has built it; a run of this crate alone may have to.
///
/// # Panics
/// When it is not there and cannot be built.
#[must_use]
pub fn program() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        let test = std::env::current_exe().unwrap();
        // target/PROFILE/deps/TEST
        let profile = test.parent().and_then(Path::parent).unwrap();
        let path = profile.join(format!("noctule{}", std::env::consts::EXE_SUFFIX));
        if !path.is_file() {
            build(profile);
        }
        assert!(path.is_file(), "{} is not there", path.display());
        path
    })
}

fn build(profile: &Path) {
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.args(["build", "--package", "noctule", "--bin", "noctule"]);
    if profile.ends_with("release") {
        cargo.arg("--release");
    }
    cargo.arg("--target-dir").arg(profile.parent().unwrap());
    let status = cargo
        .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
        .status()
        .unwrap();
    assert!(status.success(), "building noctule: {status}");
}
