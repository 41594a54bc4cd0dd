//! Weights files: what comes back, what is refused, and what the refusal says.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use noctule_erunet::{
    Config, Fault, Init, Network, NetworkError, Norms, Role, Variant, Weights, WeightsError, slots,
};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/fixtures")
        .join(name)
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

fn initial() -> Weights {
    Weights::initial(&Config::tiny(), 7, &Device::Cpu).unwrap()
}

/// Replaces bytes of equal length, once.
fn replace(bytes: &[u8], from: &str, to: &str) -> Vec<u8> {
    assert_eq!(from.len(), to.len());
    let at = bytes
        .windows(from.len())
        .position(|window| window == from.as_bytes())
        .unwrap();
    let mut out = bytes.to_vec();
    out[at..at + to.len()].copy_from_slice(to.as_bytes());
    out
}

fn faults(result: Result<(), WeightsError>) -> Vec<Fault> {
    match result {
        Err(WeightsError::Faults(faults)) => faults,
        other => panic!("wanted faults, got {other:?}"),
    }
}

#[test]
fn a_file_comes_back_with_its_config_and_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("tiny.safetensors");
    let weights = initial();
    weights.write(&path).unwrap();
    weights.write(&path).unwrap(); // over an existing file
    let read = Weights::read(&path, &Device::Cpu).unwrap();
    assert_eq!(read.config(), Some(&Config::tiny()));
    assert_eq!(read.to_bytes().unwrap(), weights.to_bytes().unwrap());
    assert_eq!(
        std::fs::read_dir(dir.path()).unwrap().count(),
        1,
        "no partial file stays"
    );
    for (name, tensor) in weights.tensors() {
        assert_eq!(values(tensor), values(&read.tensors()[name]), "{name}");
    }
}

/// Names, shapes and roles against a file this project did not write.
#[test]
fn a_reference_file_has_exactly_the_tensors_the_network_asks_for() {
    let weights = Weights::read(&fixture("tiny/weights.safetensors"), &Device::Cpu).unwrap();
    let slots = slots(&Config::tiny()).unwrap();
    assert_eq!(weights.config(), None);
    assert_eq!(slots.len(), weights.tensors().len());
    weights.check(&Config::tiny()).unwrap();
    let count = |prefix: &str| {
        slots
            .iter()
            .filter(|s| s.role == Role::Trained && s.name.starts_with(prefix))
            .count()
    };
    assert_eq!((count("efr."), count("rdu.")), (80, 223));
}

/// The reference exports its seeded start but for what its exporter makes random afterwards;
/// whatever it left alone must come out of our generator, bit for bit.
#[test]
fn a_seeded_start_equals_the_references() {
    let ours = initial();
    let theirs = Weights::read(&fixture("tiny/weights.safetensors"), &Device::Cpu).unwrap();
    let altered = ["conf.weight", "head2.weight", "gamma.weight", "beta.weight"]
        .into_iter()
        .chain(["fuse.conv2.weight", "recon.conv2.weight"]);
    let altered: Vec<&str> = altered.collect();
    let mut compared = 0;
    for (name, tensor) in theirs.tensors() {
        let is_start = tensor.rank() == 4 && !altered.iter().any(|end| name.ends_with(end));
        if is_start && !name.ends_with("atoms") {
            assert_eq!(values(&ours.tensors()[name]), values(tensor), "{name}");
            compared += 1;
        } else if name.ends_with("atoms") {
            for (a, b) in values(&ours.tensors()[name]).iter().zip(values(tensor)) {
                assert!((a - b).abs() < 1e-7, "{name}: {a} {b}");
            }
        }
    }
    let drawn = slots(&Config::tiny()).unwrap();
    let drawn = drawn
        .iter()
        .filter(|s| matches!(s.init, Init::Normal { .. }))
        .count();
    // Altered are gamma, beta, fuse.conv2, recon.conv2, head2 and the four conf.
    assert_eq!(compared, drawn - 9);
    let other = Weights::initial(&Config::tiny(), 8, &Device::Cpu).unwrap();
    let name = "efr.enc1.down.weight";
    assert_ne!(
        values(&other.tensors()[name]),
        values(&ours.tensors()[name])
    );
}

#[test]
fn every_misfit_is_listed_at_once() {
    let mut tensors = initial().tensors().clone();
    tensors.remove("efr.dec1.up.conv.bias").unwrap();
    let moved = tensors.remove("rdu.head1.weight").unwrap();
    tensors.insert("rdu.head3.weight".into(), moved);
    let wide = Tensor::zeros((4, 4), DType::F32, &Device::Cpu).unwrap();
    tensors.insert("rdu.dec0.conf.weight".into(), wide);
    let double = Tensor::zeros(4, DType::F64, &Device::Cpu).unwrap();
    tensors.insert("efr.recon.conv1.bias".into(), double);
    let negative = Tensor::new(&[1f32, -0.5, 1.0, 1.0], &Device::Cpu).unwrap();
    tensors.insert("rdu.guide.stem.bn.running_var".into(), negative);
    let result = Weights::from_tensors(&Config::tiny(), tensors, &Device::Cpu);
    let mut text: Vec<String> = faults(result.map(|_| ()))
        .iter()
        .map(Fault::to_string)
        .collect();
    text.sort();
    assert_eq!(
        text,
        [
            "efr.dec1.up.conv.bias [24] is missing",
            "efr.recon.conv1.bias holds F64, wanted F32",
            "rdu.dec0.conf.weight is [4, 4], wanted [1, 10, 3, 3]",
            "rdu.guide.stem.bn.running_var has a negative variance, -0.5",
            "rdu.head1.weight [4, 4, 3, 3] is missing",
            "rdu.head3.weight [4, 4, 3, 3] is unexpected",
        ]
    );
}

#[test]
fn weights_of_another_network_build_none() {
    let config = Config::tiny().with_variant(Variant::NoEfr);
    let Err(NetworkError::Weights(error)) = Network::new(&config, &initial(), Norms::Fold) else {
        panic!("wanted a refusal");
    };
    let faults = faults(Err(error));
    // 80 tensors of restoration are too many, the picture stem's two are missing.
    assert_eq!(
        faults
            .iter()
            .filter(|f| matches!(f, Fault::Unexpected { .. }))
            .count(),
        80
    );
    assert_eq!(
        faults
            .iter()
            .filter(|f| matches!(f, Fault::Missing { .. }))
            .count(),
        2
    );
}

#[test]
fn a_truncated_file_names_the_tensor_it_ends_in() {
    let bytes = initial().to_bytes().unwrap();
    let last = &bytes[..bytes.len() - 1];
    let error = Weights::from_bytes(last, &Device::Cpu)
        .unwrap_err()
        .to_string();
    let wanted = format!(
        "file ends within rdu.head2.weight: needs {} bytes, has {}",
        bytes.len(),
        bytes.len() - 1
    );
    assert_eq!(error, wanted);
}

/// Every length near the header's edges, and a sample of the rest.
#[test]
fn no_truncation_goes_unnoticed() {
    let bytes = initial().to_bytes().unwrap();
    for length in (0..64).chain((64..bytes.len()).step_by(997)) {
        match Weights::from_bytes(&bytes[..length], &Device::Cpu) {
            Err(WeightsError::Truncated { needed, actual, .. }) => {
                assert!(actual == length as u64 && needed > actual);
            }
            Err(WeightsError::Format(_)) => {}
            other => panic!("{length} bytes: {other:?}"),
        }
    }
    let mut longer = bytes.clone();
    longer.push(0);
    assert!(matches!(
        Weights::from_bytes(&longer, &Device::Cpu),
        Err(WeightsError::Format(_))
    ));
}

/// Flipping header bytes may yield an error or other weights, but never a panic.
#[test]
fn a_damaged_header_never_panics() {
    let bytes = initial().to_bytes().unwrap();
    let header = u64::from_le_bytes(bytes[..8].try_into().unwrap());
    let header = usize::try_from(header).unwrap();
    let mut refused = 0;
    for at in (0..8).chain((8..header).step_by(61)) {
        for flip in [0x01, 0x80] {
            let mut damaged = bytes.clone();
            damaged[at] ^= flip;
            let checked = Weights::from_bytes(&damaged, &Device::Cpu)
                .and_then(|weights| weights.check(&Config::tiny()));
            refused += usize::from(checked.is_err());
        }
    }
    assert!(refused > header / 61, "only {refused} of them were refused");
}

#[test]
fn a_file_of_other_numbers_is_refused_by_name() {
    let bytes = initial().to_bytes().unwrap();
    let integers = replace(&bytes, r#""dtype":"F32""#, r#""dtype":"I32""#);
    let faults = faults(Weights::from_bytes(&integers, &Device::Cpu).map(|_| ()));
    let [Fault::NumberFormat { name, actual }] = faults.as_slice() else {
        panic!("{faults:?}");
    };
    assert_eq!(
        (name.as_str(), actual.as_str()),
        ("efr.dec1.rb.0.conv1.bias", "I32")
    );
}

#[test]
fn values_that_are_not_finite_are_counted_by_name() {
    let mut bytes = initial().to_bytes().unwrap();
    let end = bytes.len();
    bytes[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    bytes[end - 8..end - 4].copy_from_slice(&f32::INFINITY.to_le_bytes());
    let faults = faults(Weights::from_bytes(&bytes, &Device::Cpu).map(|_| ()));
    assert_eq!(
        faults,
        [Fault::NotFinite {
            name: "rdu.head2.weight".into(),
            count: 2
        }]
    );
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let error = Weights::read(Path::new("no/such.safetensors"), &Device::Cpu).unwrap_err();
    assert!(
        error.to_string().starts_with("no/such.safetensors: "),
        "{error}"
    );
}
