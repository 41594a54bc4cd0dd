//! Collects the operations of a program and checks that each fits what it works on.

use crate::conv::Store;
use crate::layout::{SLOTS, Size};
use crate::planar::Intake;
use crate::spec::{
    Buffer, BuildError, Conv, Emit, Feature, Garf, Gate, Input, Options, Output, Passes, Plane,
    Spec, THREADS_MAX,
};

/// Largest side and number of channels: products of all of them fit a machine word.
const EXTENT_MAX: usize = 1 << 14;
/// Largest feature or slice, in numbers.
const NUMBERS_MAX: usize = 1 << 30;

/// Channels and size of one feature.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FeatureSpec {
    pub(crate) channels: usize,
    pub(crate) size: Size,
    pub(crate) is_state: bool,
}

/// One operation as described: when it runs, what it does, what profiles call it.
pub(crate) struct Described {
    pub(crate) passes: Passes,
    pub(crate) spec: Spec,
    pub(crate) label: String,
}

/// A program being described. Mistakes are collected and reported by [`Builder::finish`].
///
/// Operations run in the order they are added; each takes part in the passes set last.
pub struct Builder {
    pub(crate) features: Vec<FeatureSpec>,
    pub(crate) planes: Vec<Size>,
    inputs: Vec<usize>,
    outputs: Vec<usize>,
    pub(crate) operations: Vec<Described>,
    passes: Passes,
    label: String,
    fault: Option<BuildError>,
}

/// The caller's slices one pass touches: place in the list and length.
#[derive(Debug, Clone, Default)]
pub(crate) struct Needs {
    pub(super) inputs: Vec<(usize, usize)>,
    pub(super) outputs: Vec<(usize, usize)>,
}

impl Default for Builder {
    fn default() -> Self {
        Self::new()
    }
}

impl Builder {
    /// An empty program of one pass.
    pub fn new() -> Self {
        Self {
            features: Vec::new(),
            planes: Vec::new(),
            inputs: Vec::new(),
            outputs: Vec::new(),
            operations: Vec::new(),
            passes: Passes::of(&[0]),
            label: String::new(),
            fault: None,
        }
    }

    /// The passes that operations added from here on take part in.
    pub fn set_passes(&mut self, passes: Passes) {
        self.passes = passes;
    }

    /// What profiles call the operations added from here on.
    pub fn set_label(&mut self, label: &str) {
        label.clone_into(&mut self.label);
    }

    /// A slice of `len` values that the caller will hand in; the first is input 0.
    pub fn input(&mut self, len: usize) -> Input {
        self.require_range("length of an input", len, 1, NUMBERS_MAX, "1 to 2^30");
        self.inputs.push(len);
        self.require_range("number of inputs", self.inputs.len(), 1, SLOTS, "up to 8");
        Input(self.inputs.len() - 1)
    }

    /// A slice of `len` values that the caller will have filled; the first is output 0.
    pub fn output(&mut self, len: usize) -> Output {
        self.require_range("length of an output", len, 1, NUMBERS_MAX, "1 to 2^30");
        self.outputs.push(len);
        self.require_range("number of outputs", self.outputs.len(), 1, SLOTS, "up to 8");
        Output(self.outputs.len() - 1)
    }

    /// A feature that lives from its first write to its last read.
    pub fn feature(&mut self, channels: usize, size: Size) -> Feature {
        self.add_feature(channels, size, false)
    }

    /// A feature that keeps its values between passes.
    pub fn state(&mut self, channels: usize, size: Size) -> Feature {
        self.add_feature(channels, size, true)
    }

    fn add_feature(&mut self, channels: usize, size: Size, is_state: bool) -> Feature {
        self.require_range("number of channels", channels, 1, EXTENT_MAX, "1 to 16384");
        self.require_size(size);
        let numbers = channels.saturating_mul(size.height.saturating_mul(size.width));
        self.require_range("size of a feature", numbers, 1, NUMBERS_MAX, "1 to 2^30");
        self.features.push(FeatureSpec {
            channels,
            size,
            is_state,
        });
        Feature(self.features.len() - 1)
    }

    /// A single-precision plane that lives from its first write to its last read.
    pub fn plane(&mut self, size: Size) -> Plane {
        self.require_size(size);
        self.planes.push(size);
        Plane(self.planes.len() - 1)
    }

    /// Copies a slice into a feature.
    pub fn take(&mut self, from: Input, intake: Intake, to: Feature) {
        let feature = self.features[to.0];
        let wanted = intake.planes(feature.channels) * feature.size.area();
        self.require_count("length of the input", self.inputs[from.0], wanted);
        if matches!(intake, Intake::SparseDepth { .. }) {
            self.require_count("channels of a sparse depth", feature.channels, 2);
        }
        self.add(Spec::Take { from, intake, to });
    }

    /// Copies a feature into a slice.
    pub fn give(&mut self, from: Feature, to: Output) {
        let feature = self.features[from.0];
        let wanted = feature.channels * feature.size.area();
        self.require_count("length of the output", self.outputs[to.0], wanted);
        self.add(Spec::Give { from, to });
    }

    /// Adds a convolution.
    pub fn conv(&mut self, conv: &Conv<'_>) {
        let target = self.features[conv.output.0];
        let (inputs, from) = self.window(conv.inputs, conv.kernel);
        self.require_allowed("stride", conv.stride, &[1, 2], "1, 2");
        let scale = conv.store.scale();
        if scale > 1 {
            self.require_count("stride of a spreading store", conv.stride, 1);
        }
        let stride = conv.stride.max(1);
        let size = Size {
            height: from.height.div_ceil(stride) * scale,
            width: from.width.div_ceil(stride) * scale,
        };
        self.require_same("output", target.size, size);
        let phases = if conv.store == Store::Shuffle { 4 } else { 1 };
        let outputs = target.channels * phases;
        let weights = outputs * inputs * conv.kernel * conv.kernel;
        self.require_count("number of weights", conv.weight.len(), weights);
        let variants = (conv.bias.len() / outputs).max(1);
        self.require_count("number of biases", conv.bias.len(), variants * outputs);
        for feature in conv.gain.iter().chain(&conv.residual) {
            let other = self.features[feature.0];
            self.require_same("gain or residual", other.size, target.size);
            let channels = "channels of gain or residual";
            self.require_count(channels, other.channels, target.channels);
        }
        self.add(Spec::Conv {
            inputs: conv.inputs.to_vec(),
            weight: conv.weight.to_vec(),
            bias: conv.bias.to_vec(),
            kernel: conv.kernel,
            stride: conv.stride,
            gain: conv.gain,
            residual: conv.residual,
            activation: conv.activation,
            store: conv.store,
            output: conv.output,
        });
    }

    /// Adds a gate.
    pub fn gate(&mut self, gate: &Gate<'_>) {
        let (inputs, size) = self.window(gate.inputs, gate.kernel);
        let weights = inputs * gate.kernel * gate.kernel;
        self.require_count("number of weights", gate.weight.len(), weights);
        if let Some(plane) = gate.plane {
            self.require_same("plane", self.planes[plane.0], size);
        }
        if let Some((output, emit)) = gate.output {
            let len = self.outputs[output.0];
            self.require_count("length of the output", len, size.area());
            if let Emit::Factor { base, between, .. } = emit {
                if let Some(between) = between {
                    self.require_same("pick", self.planes[between.pick.0], size);
                    for limit in [between.drop, between.rise] {
                        let len = self.inputs[limit.0];
                        self.require_count("length of a limit", len, size.area());
                    }
                }
                self.require_count("length of the base", self.inputs[base.0], size.area());
                let beside = usize::from(gate.plane.is_some()) + usize::from(gate.kept.is_some());
                self.require_count("planes and features beside a factor", beside, 0);
            }
        }
        if let Some((from, to)) = gate.kept {
            let (from, to) = (self.features[from.0], self.features[to.0]);
            self.require_same("what is kept", from.size, size);
            self.require_same("what is kept", to.size, size);
            self.require_count("channels kept", to.channels, from.channels);
        }
        self.add(Spec::Gate {
            inputs: gate.inputs.to_vec(),
            weight: gate.weight.to_vec(),
            bias: gate.bias,
            kernel: gate.kernel,
            plane: gate.plane,
            output: gate.output,
            kept: gate.kept,
        });
    }

    /// Adds guided adaptive receptive fields.
    pub fn garf(&mut self, garf: &Garf<'_>) {
        let features = [garf.x, garf.hidden, garf.output].map(|f| self.features[f.0]);
        let [x, hidden, target] = features;
        self.require_same("hidden", hidden.size, x.size);
        self.require_same("output", target.size, x.size);
        self.require_same("trust", self.planes[garf.trust.0], x.size);
        self.require_count("channels of the output", target.channels, x.channels);
        self.require_allowed("side of the atoms", garf.side, &[1, 3, 5, 7], "1, 3, 5, 7");
        self.require_range("number of filters", garf.filters, 1, 64, "1 to 64");
        let area = garf.side * garf.side;
        let atoms = (garf.atoms.len() / area.max(1)).max(1);
        self.require_count("values of the atoms", garf.atoms.len(), atoms * area);
        let outputs = garf.filters * atoms;
        let (weight, bias) = garf.coefficients;
        self.require_count(
            "coefficient weights",
            weight.len(),
            outputs * hidden.channels,
        );
        self.require_count("coefficient biases", bias.len(), outputs);
        let (weight, bias) = garf.mix;
        let mixed = x.channels * x.channels * garf.filters;
        self.require_count("mixture weights", weight.len(), mixed);
        self.require_count("mixture biases", bias.len(), x.channels);
        let own = |(a, b): (&[f32], &[f32])| (a.to_vec(), b.to_vec());
        self.add(Spec::Garf {
            x: garf.x,
            hidden: garf.hidden,
            trust: garf.trust,
            atoms: garf.atoms.to_vec(),
            side: garf.side,
            filters: garf.filters,
            coefficients: own(garf.coefficients),
            mix: own(garf.mix),
            output: garf.output,
        });
    }

    /// The description, where it describes a program that this machine can run.
    pub(super) fn checked(mut self, options: Options) -> Result<Self, BuildError> {
        self.require_range("threads", options.threads, 1, THREADS_MAX, "1 to 64");
        self.check_order();
        if let Some(fault) = self.fault.take() {
            return Err(fault);
        }
        if !options.isa.is_available() {
            return Err(BuildError::Instructions(options.isa));
        }
        Ok(self)
    }

    /// The slices each pass touches.
    pub(crate) fn needs(&self) -> Vec<Needs> {
        let count = |passes: &Passes| 8 - passes.0.leading_zeros() as usize;
        let pass_count = self.operations.iter().map(|op| count(&op.passes)).max();
        let mut needs = vec![Needs::default(); pass_count.unwrap_or(0)];
        for Described { passes, spec, .. } in &self.operations {
            for (_, needs) in needs.iter_mut().enumerate().filter(|(p, _)| passes.has(*p)) {
                match spec {
                    Spec::Take { from, .. } => {
                        needs.inputs.push((from.0, self.inputs[from.0]));
                    }
                    Spec::Give { to, .. } => needs.outputs.push((to.0, self.outputs[to.0])),
                    Spec::Gate {
                        output: Some((to, emit)),
                        ..
                    } => {
                        needs.outputs.push((to.0, self.outputs[to.0]));
                        if let Emit::Factor { base, between, .. } = emit {
                            let limits = between.iter().flat_map(|b| [b.drop, b.rise]);
                            let read = limits.chain([*base]);
                            needs.inputs.extend(read.map(|i| (i.0, self.inputs[i.0])));
                        }
                    }
                    Spec::Conv { .. } | Spec::Gate { .. } | Spec::Garf { .. } => {}
                }
            }
        }
        needs
    }

    fn add(&mut self, spec: Spec) {
        let reads = spec.reads();
        let writes = spec.writes();
        if writes.iter().any(|w| reads.iter().any(|(r, _)| r == w)) {
            let operation = self.operations.len();
            self.blame(BuildError::Aliased { operation });
        }
        self.operations.push(Described {
            passes: self.passes,
            spec,
            label: self.label.clone(),
        });
    }

    /// Every buffer but state must have been written earlier in every pass that reads it.
    fn check_order(&mut self) {
        let mut features = vec![0u8; self.features.len()];
        let mut planes = vec![0u8; self.planes.len()];
        let mut fault = None;
        for (operation, described) in self.operations.iter().enumerate() {
            let Described { passes, spec, .. } = described;
            for (buffer, _) in spec.reads() {
                let (what, index, written) = match buffer {
                    Buffer::Feature(i) if self.features[i].is_state => continue,
                    Buffer::Feature(i) => ("feature", i, features[i]),
                    Buffer::Plane(i) => ("plane", i, planes[i]),
                };
                if passes.0 & !written != 0 {
                    fault.get_or_insert(BuildError::Unwritten {
                        operation,
                        what,
                        index,
                    });
                }
            }
            for buffer in spec.writes() {
                match buffer {
                    Buffer::Feature(i) => features[i] |= passes.0,
                    Buffer::Plane(i) => planes[i] |= passes.0,
                }
            }
        }
        if let Some(fault) = fault {
            self.blame(fault);
        }
    }

    /// Channels and size of what a window slides over.
    fn window(&mut self, inputs: &[Feature], kernel: usize) -> (usize, Size) {
        self.require_allowed("kernel", kernel, &[1, 3, 5, 7], "1, 3, 5, 7");
        let Some(first) = inputs.first() else {
            self.require_count("number of input features", 0, 1);
            return (
                0,
                Size {
                    height: 0,
                    width: 0,
                },
            );
        };
        let size = self.features[first.0].size;
        let mut channels = 0;
        for input in inputs {
            let feature = self.features[input.0];
            self.require_same("input", feature.size, size);
            channels += feature.channels;
        }
        (channels, size)
    }

    fn require_size(&mut self, size: Size) {
        for side in [size.height, size.width] {
            self.require_range("side of a feature", side, 1, EXTENT_MAX, "1 to 16384");
        }
    }

    fn require_range(
        &mut self,
        what: &'static str,
        actual: usize,
        least: usize,
        most: usize,
        allowed: &'static str,
    ) {
        if !(least..=most).contains(&actual) {
            self.blame(BuildError::Range {
                what,
                actual,
                allowed,
            });
        }
    }

    fn require_count(&mut self, what: &'static str, actual: usize, wanted: usize) {
        if actual != wanted {
            let operation = self.operations.len();
            self.blame(BuildError::Count {
                operation,
                what,
                actual,
                wanted,
            });
        }
    }

    fn require_same(&mut self, what: &'static str, actual: Size, wanted: Size) {
        if actual != wanted {
            let operation = self.operations.len();
            self.blame(BuildError::Size {
                operation,
                what,
                actual,
                wanted,
            });
        }
    }

    fn require_allowed(
        &mut self,
        what: &'static str,
        actual: usize,
        values: &[usize],
        allowed: &'static str,
    ) {
        if !values.contains(&actual) {
            let operation = self.operations.len();
            self.blame(BuildError::Unsupported {
                operation,
                what,
                actual,
                allowed,
            });
        }
    }

    /// Keeps the first fault.
    fn blame(&mut self, fault: BuildError) {
        self.fault.get_or_insert(fault);
    }
}
