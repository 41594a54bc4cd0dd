//! Exposures step by step and all at once; sizes, variants and refusals.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use candle_core::{Device, Tensor};
use noctule_erunet::{
    Config, Network, NetworkError, Norms, Pass, SIDE_MULTIPLE, Step, Variant, Weights,
};

/// Values that repeat nowhere in a picture and are the same in every run.
fn pattern(shape: &[usize], low: f32, high: f32) -> Tensor {
    let len: u32 = shape.iter().product::<usize>().try_into().unwrap();
    let share = |i: u32| (i.wrapping_mul(2_654_435_761) >> 8) as f32 / 16_777_216.0;
    let values: Vec<f32> = (0..len).map(|i| low + (high - low) * share(i)).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

struct Exposure {
    blur: Tensor,
    voxel: Tensor,
    sparse: Tensor,
}

/// One in sixteen pixels carries a return.
fn exposure(config: &Config, b: usize, h: usize, w: usize) -> Exposure {
    let t = config.steps;
    let depth = pattern(&[b, t, 1, h, w], 1.0, 70.0);
    let chosen = pattern(&[b, t, 1, h, w], 0.0, 16.0).lt(1f32).unwrap();
    let sparse = chosen
        .where_cond(&depth, &depth.zeros_like().unwrap())
        .unwrap();
    Exposure {
        blur: pattern(&[b, 3, h, w], 0.0, 1.0),
        voxel: pattern(&[b, t, config.bins, h, w], -1.0, 1.0),
        sparse,
    }
}

fn network(config: &Config) -> Network {
    let weights = Weights::initial(config, 5, &Device::Cpu).unwrap();
    Network::new(config, &weights, Norms::Fold).unwrap()
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

fn steps(network: &Network, input: &Exposure) -> Vec<Step> {
    let mut sequence = network.begin(&input.blur, None).unwrap();
    (0..network.config().steps)
        .map(|t| {
            let at = |x: &Tensor| x.narrow(1, t, 1).unwrap().squeeze(1).unwrap();
            assert_eq!(sequence.done_count(), t);
            sequence
                .step(&at(&input.voxel), &at(&input.sparse))
                .unwrap()
        })
        .collect()
}

/// Bit for bit, for every variant, a picture that is not square and an unusual number of steps.
#[test]
fn steps_one_by_one_equal_the_whole_batch_exactly() {
    for variant in [Variant::Full, Variant::NoEfr, Variant::NoHgcm] {
        for (b, count) in [(1, 5), (2, 1)] {
            let config = Config::tiny().with_steps(count).with_variant(variant);
            let (network, input) = (network(&config), exposure(&config, b, 32, 48));
            let whole = network
                .forward(&input.blur, &input.voxel, &input.sparse)
                .unwrap();
            assert_eq!(whole.depth.dims(), [b, count, 1, 32, 48]);
            assert_eq!(whole.confidence.dims(), [b, count, 1, 32, 48]);
            for (t, step) in steps(&network, &input).iter().enumerate() {
                assert_eq!(step.depth.dims(), [b, 1, 32, 48]);
                let at = |x: &Tensor| values(&x.narrow(1, t, 1).unwrap());
                assert_eq!(
                    at(&whole.depth),
                    values(&step.depth),
                    "{variant:?} depth {t}"
                );
                assert_eq!(
                    at(&whole.confidence),
                    values(&step.confidence),
                    "{variant:?} {t}"
                );
            }
        }
    }
}

#[test]
fn the_same_exposure_gives_the_same_bits() {
    let config = Config::tiny().with_steps(2);
    let (network, input) = (network(&config), exposure(&config, 1, 48, 16));
    let [first, second] = [(); 2].map(|()| steps(&network, &input));
    for (a, b) in first.iter().zip(&second) {
        assert_eq!(values(&a.depth), values(&b.depth));
    }
}

#[test]
fn depth_and_confidence_stay_in_their_ranges() {
    let config = Config {
        d_max: 10.0,
        ..Config::tiny()
    };
    let (network, input) = (network(&config), exposure(&config, 1, 32, 32));
    let outputs = network
        .forward(&input.blur, &input.voxel, &input.sparse)
        .unwrap();
    assert!(
        values(&outputs.depth)
            .iter()
            .all(|d| (0.0..=10.0).contains(d))
    );
    assert!(
        values(&outputs.confidence)
            .iter()
            .all(|c| (0.0..=1.0).contains(c))
    );
}

/// What a later step sees depends on the earlier ones only through restoration.
#[test]
fn events_of_a_step_reach_later_steps_and_never_earlier_ones() {
    let config = Config::tiny();
    let (network, mut input) = (network(&config), exposure(&config, 1, 32, 32));
    let before = steps(&network, &input);
    let middle = input
        .voxel
        .narrow(1, 1, 1)
        .unwrap()
        .affine(-1.0, 0.0)
        .unwrap();
    let parts = [
        input.voxel.narrow(1, 0, 1),
        Ok(middle),
        input.voxel.narrow(1, 2, 1),
    ];
    input.voxel = Tensor::cat(&parts.map(Result::unwrap), 1).unwrap();
    let after = steps(&network, &input);
    let is_same = |t: usize| values(&before[t].depth) == values(&after[t].depth);
    assert_eq!([is_same(0), is_same(1), is_same(2)], [true, false, false]);
}

#[test]
fn the_ablations_ignore_what_they_leave_out() {
    let config = Config::tiny().with_variant(Variant::NoEfr);
    let (first, input) = (network(&config), exposure(&config, 1, 32, 32));
    assert!(first.reconstruct(&[], &input.blur).unwrap().is_none());
    let mut pass = Pass::tracing();
    let clear = first.restore(&input.blur, &input.voxel, &mut pass).unwrap();
    assert_eq!(pass.features().count(), 0);
    assert!(
        clear
            .iter()
            .all(|feature| values(feature) == values(&clear[0]))
    );

    // Without the event pyramid, events reach completion through restoration alone.
    let config = Config::tiny().with_variant(Variant::NoHgcm);
    let (network, input) = (network(&config), exposure(&config, 1, 32, 32));
    let mut pass = Pass::plain();
    let clear = network
        .restore(&input.blur, &input.voxel, &mut pass)
        .unwrap();
    let depth = |voxel: &Tensor| {
        let outputs = network
            .complete(&clear, voxel, &input.sparse, &mut Pass::plain())
            .unwrap();
        values(&outputs.depth)
    };
    assert_eq!(depth(&input.voxel), depth(&input.voxel.neg().unwrap()));
}

#[test]
fn inputs_of_the_wrong_shape_are_named_and_change_nothing() {
    let config = Config::tiny();
    let (network, input) = (network(&config), exposure(&config, 1, 32, 48));
    let error = |result: Result<(), NetworkError>| result.unwrap_err().to_string();
    let odd = pattern(&[1, 3, 32, 40], 0.0, 1.0);
    assert_eq!(
        error(network.begin(&odd, None).map(|_| ())),
        format!(
            "blur has shape [1, 3, 32, 40], wanted [B, 3, H, W] with H and W multiples of \
             {SIDE_MULTIPLE}"
        )
    );
    let grey = pattern(&[1, 1, 32, 48], 0.0, 1.0);
    assert!(network.begin(&grey, None).is_err());

    let mut sequence = network.begin(&input.blur, None).unwrap();
    let voxel = pattern(&[1, 5, 32, 48], -1.0, 1.0);
    let sparse = pattern(&[1, 1, 32, 48], 0.0, 70.0);
    let small = pattern(&[1, 1, 32, 32], 0.0, 70.0);
    assert_eq!(
        error(sequence.step(&voxel, &small).map(|_| ())),
        "sparse has shape [1, 1, 32, 32], wanted [1, 1, 32, 48]"
    );
    assert_eq!(
        error(sequence.step(&sparse, &sparse).map(|_| ())),
        "voxel has shape [1, 1, 32, 48], wanted [1, 5, 32, 48]"
    );
    assert_eq!(sequence.done_count(), 0);
    for _ in 0..3 {
        sequence.step(&voxel, &sparse).unwrap();
    }
    assert_eq!(
        error(sequence.step(&voxel, &sparse).map(|_| ())),
        "all 3 steps of the exposure are done"
    );

    let four = exposure(&config.clone().with_steps(4), 1, 32, 48);
    assert_eq!(
        error(
            network
                .forward(&input.blur, &four.voxel, &input.sparse)
                .map(|_| ())
        ),
        "voxel has shape [1, 4, 5, 32, 48], wanted [1, 3, 5, 32, 48]"
    );
    assert_eq!(
        error(
            network
                .forward(&input.blur, &input.voxel, &four.sparse)
                .map(|_| ())
        ),
        "sparse has shape [1, 4, 1, 32, 48], wanted [1, 3, 1, 32, 48]"
    );
    let none = network.complete(&[], &input.voxel, &input.sparse, &mut Pass::plain());
    assert_eq!(
        error(none.map(|_| ())),
        "clear has shape [0], wanted 3 features"
    );
}

#[test]
fn a_number_out_of_range_builds_no_network() {
    let weights = Weights::initial(&Config::tiny(), 5, &Device::Cpu).unwrap();
    let config = Config {
        cd: 0,
        ..Config::tiny()
    };
    let error = Network::new(&config, &weights, Norms::Fold).err().unwrap();
    assert_eq!(error.to_string(), "cd is 0 channels, allowed 1 to 4096");
}
