//! The table of an inference benchmark.

use std::fmt::Write as _;

use noctule_erunet::LayerProfile;
use noctule_kernels::Isa;
use serde::Serialize;

use super::machine::Machine;

/// One network, compiled in one way.
#[derive(Debug, Clone, Serialize)]
pub struct InferRow {
    /// Name of the network.
    pub config: String,
    /// `f32` or `bf16`.
    pub precision: String,
    /// Threads.
    pub threads: usize,
    /// Side of the picture, pixels.
    pub size: usize,
    /// Depth maps per exposure.
    pub steps: usize,
    /// Multiply-adds per exposure, in units of 10^9, as the architecture counts them.
    pub gmac: f64,
    /// Picture in to last depth map out.
    pub seconds_median: f64,
    /// The shortest of them.
    pub seconds_min: f64,
    /// Picture in to first depth map out, median.
    pub first_step_seconds: f64,
    /// Two operations per multiply-add over the median time, as a share of the threads' peak in
    /// this precision.
    pub share_of_peak: f64,
    /// Largest difference to candle's single-precision depth, metres.
    pub max_abs_err_m: Option<f64>,
    /// Mean difference.
    pub mean_abs_err_m: Option<f64>,
    /// Mean difference over the mean of candle's depth.
    pub mean_err_share: Option<f64>,
    /// Bytes of all features.
    pub arena_bytes: usize,
    /// Bytes of the packed weights.
    pub weight_bytes: usize,
    /// Where the time goes.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub layers: Vec<LayerRow>,
}

/// One layer.
#[derive(Debug, Clone, Serialize)]
pub struct LayerRow {
    /// Its name in the network.
    pub name: String,
    /// What it is.
    pub kind: String,
    /// Height and width of what it computes.
    pub size: [usize; 2],
    /// Runs per exposure.
    pub runs: usize,
    /// Multiply-adds per run.
    pub macs: u64,
    /// Bytes of features and weights per run, each counted once.
    pub bytes: u64,
    /// Shortest time of a run.
    pub seconds: f64,
    /// Least time of a run by the machine's peak and bandwidth.
    pub bound_seconds: f64,
}

impl From<LayerProfile> for LayerRow {
    fn from(layer: LayerProfile) -> Self {
        let LayerProfile { op, runs } = layer;
        Self {
            name: op.name,
            kind: op.kind,
            size: op.size,
            runs,
            macs: op.macs,
            bytes: op.feature_bytes + op.weight_bytes,
            seconds: op.seconds,
            bound_seconds: 0.0,
        }
    }
}

impl LayerRow {
    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
    fn total(&self, seconds: f64) -> f64 {
        self.runs as f64 * seconds
    }
}

/// An inference benchmark.
#[derive(Debug, Clone, Serialize)]
pub struct InferBench {
    /// Instructions used.
    pub isa: String,
    /// Multiply-adds of one core, two operations each, GFLOP/s.
    pub peak_gflops_f32: f64,
    /// The same with bfloat16 factors.
    pub peak_gflops_bf16: f64,
    /// Bytes one core reads and writes, GB/s.
    pub bandwidth_gb_s: f64,
    /// One row per combination.
    pub rows: Vec<InferRow>,
}

impl InferBench {
    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
    pub(super) fn new(machine: Machine, isa: Isa, mut rows: Vec<InferRow>) -> Self {
        for row in &mut rows {
            let threads = row.threads as f64;
            let flops = threads * machine.flops(&row.precision);
            row.share_of_peak = 2e9 * row.gmac / row.seconds_median / flops;
            for layer in &mut row.layers {
                let computing = 2.0 * layer.macs as f64 / flops;
                let moving = layer.bytes as f64 / (threads * machine.bandwidth);
                layer.bound_seconds = computing.max(moving);
            }
        }
        Self {
            isa: format!("{isa:?}"),
            peak_gflops_f32: machine.flops_f32 / 1e9,
            peak_gflops_bf16: machine.flops_bf16 / 1e9,
            bandwidth_gb_s: machine.bandwidth / 1e9,
            rows,
        }
    }

    /// The tables for reading.
    #[must_use]
    pub fn text(&self) -> String {
        let mut text = format!(
            "{}: {:.0} GFLOP/s f32, {:.0} bf16, {:.1} GB/s per core\n{:<6} {:<4} {:>7} {:>4} \
             {:>5} {:>8} {:>9} {:>9} {:>9} {:>7} {:>10} {:>8}\n",
            self.isa,
            self.peak_gflops_f32,
            self.peak_gflops_bf16,
            self.bandwidth_gb_s,
            "config",
            "prec",
            "threads",
            "size",
            "steps",
            "GMAC",
            "median ms",
            "min ms",
            "first ms",
            "of peak",
            "mean err",
            "arena MB",
        );
        for row in &self.rows {
            row.write(&mut text);
        }
        for row in self.rows.iter().filter(|row| !row.layers.is_empty()) {
            row.write_layers(&mut text);
        }
        text
    }
}

impl InferRow {
    fn write(&self, text: &mut String) {
        let error = self
            .mean_err_share
            .map_or_else(|| "-".to_owned(), |share| format!("{:.4}%", share * 1e2));
        #[expect(clippy::cast_precision_loss, reason = "shown with one decimal")]
        let arena_mb = self.arena_bytes as f64 / 1e6;
        let _ = writeln!(
            text,
            "{:<6} {:<4} {:>7} {:>4} {:>5} {:>8.2} {:>9.2} {:>9.2} {:>9.2} {:>6.1}% {error:>10} \
             {arena_mb:>8.1}",
            self.config,
            self.precision,
            self.threads,
            self.size,
            self.steps,
            self.gmac,
            self.seconds_median * 1e3,
            self.seconds_min * 1e3,
            self.first_step_seconds * 1e3,
            self.share_of_peak * 100.0,
        );
    }

    fn write_layers(&self, text: &mut String) {
        let _ = writeln!(
            text,
            "\n{} {} {} threads, layer by layer: ms per exposure, share, GFLOP/s, share of the \
             roofline's rate",
            self.config, self.precision, self.threads
        );
        let all: f64 = self.layers.iter().map(|l| l.total(l.seconds)).sum();
        for layer in &self.layers {
            #[expect(clippy::cast_precision_loss, reason = "shown with one decimal")]
            let rate = 2e-9 * layer.macs as f64 / layer.seconds;
            let spent = layer.total(layer.seconds);
            let [height, width] = layer.size;
            let _ = writeln!(
                text,
                "{:<26} {:<24} {height:>3}x{width:<3} {:>8.3} {:>5.1}% {rate:>7.1} {:>6.1}%",
                layer.name,
                layer.kind,
                spent * 1e3,
                100.0 * spent / all,
                100.0 * layer.bound_seconds / layer.seconds,
            );
        }
        let bound: f64 = self.layers.iter().map(|l| l.total(l.bound_seconds)).sum();
        let _ = writeln!(
            text,
            "all layers {:.2} ms, roofline {:.2} ms ({:.1} %)",
            all * 1e3,
            bound * 1e3,
            100.0 * bound / all
        );
    }
}
