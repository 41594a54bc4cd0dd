//! Real captures with expected decodes, looked for below `$NOCTULE_DATA/hesai`.

use std::fs::{self, File};
use std::io::BufReader;
use std::path::PathBuf;

use noctule_hesai::pcap::Reader;
use noctule_hesai::{Correction, Model};

/// The four sensors there are captures of: file name stem, angle table and model.
pub const SENSORS: [(&str, &str, Model); 4] = [
    ("qt64", "PandarQT64.csv", Model::Qt64),
    ("qt128", "PandarQT128.csv", Model::Qt128),
    ("xt32", "PandarXT32.csv", Model::Xt32),
    ("pandar64", "Pandar64.csv", Model::Pandar64),
];

/// The captures' folder; `None`, said aloud, where there is none.
pub fn folder(test: &str) -> Option<PathBuf> {
    let Some(data) = std::env::var_os("NOCTULE_DATA") else {
        eprintln!("{test}: SKIPPED, NOCTULE_DATA is not set; generated packets are tested alone");
        return None;
    };
    Some(PathBuf::from(data).join("hesai"))
}

/// All payloads of a capture.
pub fn payloads(path: PathBuf) -> Vec<Vec<u8>> {
    let mut reader = Reader::new(BufReader::new(File::open(path).unwrap())).unwrap();
    let mut payloads = Vec::new();
    while let Some(datagram) = reader.next_datagram().unwrap() {
        payloads.push(datagram.payload.to_vec());
    }
    payloads
}

/// A sensor's own angle table.
#[allow(dead_code, reason = "each test crate uses what it needs")]
pub fn correction(folder: &std::path::Path, table: &str, model: Model) -> Correction {
    Correction::from_csv(model, &fs::read_to_string(folder.join(table)).unwrap()).unwrap()
}
