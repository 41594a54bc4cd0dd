//! What a window of an exposure costs, held to the same steps of the whole exposure.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use candle_core::Device;
use noctule_erunet::{Config, Network, Norms, Pass, Weights};
use noctule_learn::{Batch, Example, Inputs, Kind, Loss, batch_loss, depth_loss};
use noctule_world::Tier;

/// Steps 4 to 6 as the loader cuts them: events from the shutter's opening, the rest of the window.
fn window_of(whole: &Inputs, first: usize, count: usize) -> Inputs {
    Inputs {
        voxel: whole.voxel.narrow(1, 0, first + count).unwrap(),
        sparse: whole.sparse.narrow(1, first, count).unwrap(),
        depth: whole.depth.narrow(1, first, count).unwrap(),
        first_step: first,
        ..whole.clone()
    }
}

#[test]
fn a_window_costs_what_its_steps_of_the_whole_exposure_cost() {
    let example = Example::render(8, Tier::B, 64).unwrap();
    let batch = Batch::whole(&example, None, 80.0).unwrap();
    let whole = batch.to_device(&Device::Cpu).unwrap();
    assert!(example.ground.is_some(), "nights know their ground");
    let config = Config::xs().with_steps(8);
    let weights = Weights::initial(&config, 3, &Device::Cpu).unwrap();
    let network = Network::new(&config, &weights, Norms::Keep).unwrap();
    let mut pass = Pass::plain();
    pass.stand_over(vec![example.ground]);
    let clear = network
        .restore(&whole.blur, &whole.voxel, &mut pass)
        .unwrap();
    let outputs = network
        .complete(&clear, &whole.voxel, &whole.sparse, &mut pass)
        .unwrap();
    let loss = Loss::default();
    for (first, count) in [(0, 2), (3, 3), (7, 1)] {
        let window = window_of(&whole, first, count);
        let found = batch_loss(&network, Kind::Joint, &window, &loss, &mut Pass::plain()).unwrap();
        let found = found
            .terms
            .iter()
            .find(|(name, _)| *name == "dense")
            .unwrap()
            .1;
        let depth = outputs.depth.narrow(1, first, count).unwrap();
        let wanted = depth_loss(&depth, &window.depth, &window.sparse, [None, None], &loss);
        let wanted = f64::from(wanted.unwrap().dense.to_scalar::<f32>().unwrap());
        assert!(
            (found - wanted).abs() <= 1e-5 * wanted,
            "steps from {first}: {found}, in the whole exposure {wanted}"
        );
    }
}
