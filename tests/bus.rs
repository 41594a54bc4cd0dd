//! The bus between ports of one process, over real shared memory: what two processes see.
#![allow(
    clippy::unwrap_used,
    reason = "a test that cannot set itself up has failed"
)]

use std::time::Duration;

use noctule::bus::{BusError, ChannelLimits, Instance, Ipc, Limits, Owner, Ports};
use noctule::frame::{BundleHeader, DepthHeader};

fn instance(name: &str) -> Instance {
    noctule::bus::silence_transport_log();
    Instance::new(
        format!("test-{name}-{}", std::process::id())
            .parse()
            .unwrap(),
    )
}

fn limits() -> Limits {
    let small = ChannelLimits {
        blocks: 8,
        receivers: 2,
        queue: 2,
        held: 2,
        loans: 2,
    };
    Limits {
        bundle: small,
        depth: small,
    }
}

#[test]
fn a_receiver_sees_what_was_written_in_place() {
    let owner = Owner::<Ipc>::create(instance("place"), limits()).unwrap();
    let sender = owner.ports().bundle_sender().unwrap();
    let receiver = owner.ports().bundle_receiver().unwrap();
    let mut loan = sender.loan().unwrap();
    *loan.header_mut() = BundleHeader {
        sequence: 7,
        ..Default::default()
    };
    loan.payload_mut()[3].lanes[5] = 1.5;
    assert_eq!(sender.send(loan).unwrap(), 1);
    receiver.wait(Duration::from_secs(1)).unwrap();
    let received = receiver.receive().unwrap().unwrap();
    assert_eq!(received.header().sequence, 7);
    assert_eq!(received.payload().len(), 8);
    assert_eq!(received.payload()[3].lanes[5], 1.5);
    assert_eq!(received.payload().as_ptr() as usize % 64, 0);
}

#[test]
fn overwritten_frames_are_counted_as_a_gap() {
    let owner = Owner::<Ipc>::create(instance("gap"), limits()).unwrap();
    let sender = owner.ports().depth_sender().unwrap();
    let receiver = owner.ports().depth_receiver().unwrap();
    let send = |frame| {
        let mut loan = sender.loan().unwrap();
        *loan.header_mut() = DepthHeader {
            frame,
            ..Default::default()
        };
        sender.send(loan).unwrap();
    };
    send(0);
    assert_eq!(receiver.receive().unwrap().unwrap().header().frame, 0);
    (1..=5).for_each(send);
    let newest = receiver.receive_newest().unwrap().unwrap();
    assert_eq!((newest.frame.header().frame, newest.passed_over), (5, 1));
    assert_eq!((receiver.received(), receiver.lost()), (3, 3));
    drop(newest);
    (6..=8).for_each(send);
    receiver.receive_newest().unwrap();
    assert_eq!(
        (receiver.received(), receiver.lost()),
        (5, 4),
        "a gap of one counts too"
    );
}

#[test]
fn an_instance_has_one_owner_and_leaves_nothing_behind() {
    let instance = instance("owner");
    let owner = Owner::<Ipc>::create(instance.clone(), limits()).unwrap();
    assert!(!instance.residue().is_empty());
    let second = Owner::<Ipc>::create(instance.clone(), limits());
    assert!(matches!(second, Err(BusError::Running(_))), "{second:?}");
    {
        let ports = Ports::<Ipc>::open(instance.clone(), "reader", limits()).unwrap();
        let _receiver = ports.depth_receiver().unwrap();
    }
    drop(owner);
    assert_eq!(instance.residue(), Vec::<std::path::PathBuf>::new());
}

#[test]
fn without_an_owner_there_is_nothing_to_open() {
    let instance = instance("none");
    let error = Ports::<Ipc>::open(instance.clone(), "reader", limits()).unwrap_err();
    assert!(
        matches!(
            error,
            BusError::NotRunning {
                service: "bundle",
                ..
            }
        ),
        "{error}"
    );
}
