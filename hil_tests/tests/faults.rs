//! Killed and interrupted processes: the rest goes on, nothing is left behind.
#![allow(clippy::unwrap_used, reason = "a test may stop where it stands")]

use std::thread;
use std::time::Duration;

use noctule_hil_tests::{Ended, Stage, Started, residue, wait_until_gone};
use rustix::process::{Signal, kill_process};

fn instance(name: &str) -> String {
    format!("hil-{name}-{}", std::process::id())
}

/// Waits for the end of a whole run and checks that it ended well.
fn ended_well(run: Started, instance: &str) -> Ended {
    let ended = run.wait();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert_eq!(residue(instance), [] as [std::path::PathBuf; 0]);
    ended
}

fn sent(ended: &Ended) -> u64 {
    ended.report()["host"]["bundles"]["sent"].as_u64().unwrap()
}

/// Lets the run get going: its inference process is up and has something to do.
fn under_way(run: &mut Started) -> rustix::process::Pid {
    let infer = run.child_of_name("infer");
    thread::sleep(Duration::from_millis(800));
    infer
}

#[test]
fn a_killed_inference_process_does_not_stop_the_host() {
    let stage = Stage::shared();
    let name = instance("whole");
    let whole = ended_well(stage.replay(&name, &["--pace", "max", "--lossless"]), &name);
    for (word, arguments) in [
        ("live", &["--pace", "0.7"][..]),
        ("lossless", &["--pace", "0.7", "--lossless"][..]),
    ] {
        let name = instance(word);
        let mut run = stage.replay(&name, arguments);
        kill_process(under_way(&mut run), Signal::KILL).unwrap();
        let ended = ended_well(run, &name);
        let report = ended.report();
        assert!(report["infer_restarts"].as_u64().unwrap() >= 1, "{word}");
        assert_eq!(sent(&ended), sent(&whole), "{word}");
        assert!(
            report["infer"]["frames_sent"].as_u64().unwrap() > 0,
            "{word}"
        );
    }
}

#[test]
fn an_interrupt_ends_everything_within_five_seconds() {
    let stage = Stage::shared();
    for killed_before in [false, true] {
        let name = instance(if killed_before { "killed" } else { "interrupt" });
        let mut run = stage.replay(&name, &["--pace", "0.1"]);
        let infer = under_way(&mut run);
        assert!(!residue(&name).is_empty(), "a run holds shared memory");
        if killed_before {
            kill_process(infer, Signal::KILL).unwrap();
            wait_until_gone(infer);
            run.child_of_name("infer");
        }
        run.ctrl_c();
        let ended = run.wait_at_most(Duration::from_secs(5));
        assert_eq!(ended.code, Some(130), "{}", ended.stderr);
        // The part of the drive that was seen, reported as ever.
        let report = ended.report();
        assert_eq!(
            report["infer_restarts"].as_u64(),
            Some(u64::from(killed_before))
        );
        assert!(report["digest"].is_string());
        assert_eq!(residue(&name), [] as [std::path::PathBuf; 0]);
        wait_until_gone(infer);
    }
}

#[test]
fn what_a_killed_host_left_is_cleared_by_the_next_of_its_name() {
    let stage = Stage::shared();
    let name = instance("orphan");
    let mut run = stage.replay(&name, &["--pace", "0.1"]);
    let infer = under_way(&mut run);
    run.signal(Signal::KILL);
    assert_eq!(run.wait().code, None);
    // The child learns of its parent's death and holds the name no longer.
    wait_until_gone(infer);
    assert!(
        !residue(&name).is_empty(),
        "a killed process clears nothing away"
    );
    let next = ended_well(stage.replay(&name, &["--pace", "max", "--lossless"]), &name);
    assert!(sent(&next) > 0);
}

#[test]
fn two_instances_side_by_side_do_not_disturb_each_other() {
    let stage = Stage::shared();
    let lossless = ["--pace", "max", "--lossless"];
    let name = instance("single");
    let single = ended_well(stage.replay(&name, &lossless), &name);
    let names = [instance("left"), instance("right")];
    let [left, right] = names.each_ref().map(|name| stage.replay(name, &lossless));
    for (run, name) in [(left, &names[0]), (right, &names[1])] {
        let ended = ended_well(run, name);
        assert_eq!(
            ended.report()["digest"],
            single.report()["digest"],
            "{name}"
        );
    }
}

#[test]
fn a_name_that_is_taken_is_refused_and_its_holder_left_alone() {
    let stage = Stage::shared();
    let name = instance("taken");
    let mut holder = stage.replay(&name, &["--pace", "1"]);
    under_way(&mut holder);
    let second = stage.replay(&name, &["--pace", "max"]).wait();
    assert_eq!(second.code, Some(1));
    assert!(second.stderr.contains(&name), "{}", second.stderr);
    assert!(sent(&ended_well(holder, &name)) > 0);
}
