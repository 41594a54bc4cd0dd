//! Where the time of a plan goes, layer by layer.

use noctule_kernels::OpProfile;

use super::{
    BEGIN, BLUR, DROP, FIRST, LATER, NEAREST, Plan, PlanError, RISE, SLICES, SPARSE, VOXEL, limits,
};

/// One layer of the network: what it costs, and how often an exposure asks for it.
#[derive(Debug, Clone, PartialEq)]
pub struct LayerProfile {
    /// The operation by its name in the network (`rdu.dec0.merge`), its work per run and its time.
    pub op: OpProfile,
    /// Runs per exposure: once at the beginning or in the first step, or in every later step.
    pub runs: usize,
}

impl Plan {
    /// Times every layer over `repeats` exposures, at least one, of grey pictures and a few
    /// returns, and drops the exposure that was going on. Layers of both the first and the later
    /// steps appear once for each. The shortest of all runs counts; a barrier around every layer
    /// makes the sum a little longer than a run.
    pub fn profile(&mut self, repeats: usize) -> Result<Vec<LayerProfile>, PlanError> {
        self.done = None;
        let blur = vec![0.5; 3 * self.area];
        let voxel = vec![0.1; self.bins * self.area];
        let sparse: Vec<f32> = (0..self.area)
            .map(|i| if i % 31 == 0 { 20.0 } else { 0.0 })
            .collect();
        let (mut depth, mut trust) = (vec![0.0; self.area], vec![0.0; self.area]);
        let planes = self.filled.as_ref().map_or(0, |filled| filled.seen.len());
        let (seen, nearest) = (vec![0.25; planes], vec![20.0; self.area]);
        let mut slices: [&[f32]; SLICES] = [&[]; SLICES];
        slices[BLUR] = &blur;
        slices[VOXEL] = &voxel;
        slices[SPARSE] = &sparse;
        if self.filled.is_some() {
            (slices[SPARSE], slices[NEAREST]) = (&seen, &nearest);
            (slices[DROP], slices[RISE]) = limits(&seen, self.area);
        }
        let mut layers = Vec::new();
        for _ in 0..repeats.max(1) {
            let passes = [(BEGIN, 0..1), (FIRST, 0..1), (LATER, 1..self.steps)];
            for (pass, steps) in passes {
                let runs = steps.len();
                for step in steps {
                    let variant = if self.place.is_empty() { 0 } else { step };
                    let mut outputs: [&mut [f32]; 2] = [&mut depth, &mut trust];
                    let ops = self
                        .program
                        .profile(pass, variant, &slices, &mut outputs, 1)?;
                    keep_shortest(&mut layers, pass, runs, ops);
                }
            }
        }
        Ok(layers)
    }
}

/// Adds the operations of one pass, or lowers the times of those already there.
fn keep_shortest(layers: &mut Vec<LayerProfile>, pass: usize, runs: usize, ops: Vec<OpProfile>) {
    let first = layers.iter().position(|layer| layer.op.pass == pass);
    let Some(first) = first else {
        layers.extend(ops.into_iter().map(|op| LayerProfile { op, runs }));
        return;
    };
    for (layer, op) in layers[first..].iter_mut().zip(ops) {
        layer.op.seconds = layer.op.seconds.min(op.seconds);
    }
}
