//! Lone files open as recordings of one sensor: real captures where `NOCTULE_DATA` names them, and
//! files of the project's own making.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod made_up;

use std::fs;
use std::path::PathBuf;

use made_up::{at, delivered};
use noctule_evk4::Geometry;
use noctule_recording::{Missing, Recording};
use noctule_sensor::{Realtime, Stamp};

fn captures() -> Option<PathBuf> {
    let data = std::env::var_os("NOCTULE_DATA").map(PathBuf::from);
    if data.is_none() {
        eprintln!("NOCTULE_DATA is not set: SKIPPING the real captures, own recordings only");
    }
    data
}

/// Length, first and last arrival, and number of transfers.
fn walk(recording: &Recording) -> (u64, Stamp<Realtime>, Stamp<Realtime>, usize) {
    let mut stream = recording.event_transfers().unwrap();
    let mut at = stream.header_bytes().len() as u64;
    let (mut first, mut last, mut count) = (None, Stamp::ZERO, 0);
    while let Some(transfer) = stream.next_transfer().unwrap() {
        assert_eq!(transfer.offset, at);
        at += transfer.bytes.len() as u64;
        assert!(transfer.arrival >= last, "arrivals go back");
        first = first.or(Some(transfer.arrival));
        last = transfer.arrival;
        count += 1;
    }
    assert!(stream.faults().is_clean(), "{:?}", stream.faults());
    (at, first.unwrap(), last, count)
}

/// The last rows and lengths are those of the files `data/events/*.packets.csv`.
#[test]
fn real_raw_files_arrive_as_their_packets_did() {
    let Some(data) = captures() else { return };
    for (name, bytes, first, last, count) in [
        (
            "hd720_trigger2",
            758_472,
            1_665_782_665_852_541_635,
            1_665_782_667_088_535_074,
            105,
        ),
        (
            "vga_trigger_loop_a",
            1_309_160,
            1_675_956_550_318_678_998,
            1_675_956_551_638_735_967,
            330,
        ),
    ] {
        let path = data.join("events").join(name).with_extension("raw");
        let recording = Recording::from_raw_file(&path).unwrap();
        assert!(!recording.missing().contains(&Missing::EventArrivals));
        assert_eq!(recording.meta().name, name);
        let stamps = (Stamp::from_nanos(first), Stamp::from_nanos(last));
        assert_eq!(walk(&recording), (bytes, stamps.0, stamps.1, count));
    }
}

/// 8.8 ms of real events (`data/events/MANIFEST.md`).
#[test]
fn a_real_raw_file_without_packets_arrives_by_its_sensor_time() {
    let Some(data) = captures() else { return };
    let path = data.join("events/gen41_hd_vect.raw");
    let recording = Recording::from_raw_file(&path).unwrap();
    assert!(recording.missing().contains(&Missing::EventArrivals));
    let (bytes, first, last, _) = walk(&recording);
    assert_eq!(bytes, fs::metadata(&path).unwrap().len());
    let span_ns = last.diff_nanos(first);
    assert!((8_000_000..9_000_000).contains(&span_ns), "{span_ns}");
}

/// 930 packets, 1072 bytes each (`data/hesai/MANIFEST.md`).
#[test]
fn a_real_capture_is_a_recording_of_its_datagrams() {
    let Some(data) = captures() else { return };
    let recording = Recording::from_pcap(&data.join("hesai/qt64.pcap")).unwrap();
    let mut capture = recording.datagrams().unwrap();
    let (mut count, mut last) = (0, Stamp::ZERO);
    while let Some(datagram) = capture.next_datagram().unwrap() {
        assert_eq!((datagram.dst_port, datagram.payload.len()), (2368, 1072));
        assert!(datagram.t > last);
        last = datagram.t;
        count += 1;
    }
    assert_eq!((count, capture.skipped().total()), (930, 0));
    assert!(capture.faults().is_clean());
}

/// Times worked out by hand: each group of words is TIME_HIGH h, TIME_LOW l, row 0 and one event,
/// which thus happens at (h << 12 | l) us; 512 groups fill a chunk.
#[test]
fn arrivals_made_up_from_sensor_time_are_what_each_chunk_reaches() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.raw");
    let mut bytes = b"% format EVT3;height=720;width=1280\n% end\n".to_vec();
    let header_len = bytes.len() as u64;
    for k in 0..1024u16 {
        for word in [0x8000 | (k / 100), 0x6000 | (k % 100), 0, 0x2005] {
            bytes.extend(word.to_le_bytes());
        }
    }
    bytes.extend([0x00, 0x80, 0x07]);
    fs::write(&path, &bytes).unwrap();
    let recording = Recording::from_raw_file(&path).unwrap();
    let mut stream = recording.event_transfers().unwrap();
    let mut chunks = Vec::new();
    while let Some(transfer) = stream.next_transfer().unwrap() {
        let offset = transfer.offset - header_len;
        chunks.push((offset, transfer.bytes.len(), transfer.arrival));
    }
    let micros = |k: u64| Stamp::from_micros(((k / 100) << 12) | (k % 100));
    assert_eq!(chunks[0], (0, 4096, micros(511)));
    assert_eq!(chunks[1], (4096, 4096, micros(1023)));
    assert_eq!((chunks.len(), chunks[2].0, chunks[2].1), (3, 8192, 3));
}

#[test]
fn a_packets_table_gives_transfers_and_arrivals() {
    let dir = tempfile::tempdir().unwrap();
    let given = delivered();
    let path = dir.path().join("drive.raw");
    let mut bytes = given.header.clone();
    let mut table = "seq,byte_offset,byte_length,driver_stamp_ns,bag_receive_ns\n".to_owned();
    for (k, (transfer, arrival)) in given.transfers.iter().enumerate() {
        let row = format!(
            "{k},{},{},{},7\n",
            bytes.len(),
            transfer.len(),
            arrival.as_nanos()
        );
        table.push_str(&row);
        bytes.extend(transfer);
    }
    fs::write(&path, &bytes).unwrap();
    fs::write(dir.path().join("drive.packets.csv"), table).unwrap();
    let recording = Recording::from_raw_file(&path).unwrap();
    let last = at(given.transfers.len() - 1);
    let expected = (bytes.len() as u64, at(0), last, given.transfers.len());
    assert_eq!(walk(&recording), expected);
    let missing = recording.missing();
    assert!(!missing.contains(&Missing::EventArrivals) && !missing.contains(&Missing::Events));
    assert!(missing.contains(&Missing::Calibration) && missing.contains(&Missing::Lidar));
}

#[test]
fn files_that_are_neither_are_refused_with_their_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.bin");
    fs::write(&path, b"neither").unwrap();
    let raw = Recording::from_raw_file(&path).unwrap_err().to_string();
    assert!(raw.contains("x.bin: no raw header"), "{raw}");
    let pcap = Recording::from_pcap(&path).unwrap_err().to_string();
    assert!(pcap.contains("x.bin: byte 0: "), "{pcap}");
    let sizeless = dir.path().join("y.raw");
    fs::write(&sizeless, b"% evt 3.0\n% end\n").unwrap();
    let error = Recording::from_raw_file(&sizeless).unwrap_err().to_string();
    assert!(error.contains("gives no geometry"), "{error}");
    let geometry = Geometry {
        width: 640,
        height: 480,
    };
    let recording = Recording::from_raw_file_with(&sizeless, Some(geometry)).unwrap();
    assert_eq!(recording.meta().crop.width, 640);
    assert!(
        recording
            .event_transfers()
            .unwrap()
            .next_transfer()
            .unwrap()
            .is_none()
    );
}
