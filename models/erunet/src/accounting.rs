//! What a configuration costs: parameters and multiply-adds, module by module, from its widths.
//!
//! Counted are convolutions, the correlations with GARF's atoms and their contraction; not biases,
//! norms and activations, and not the reconstruction head, which inference does not run. GARF is
//! counted in the paper's order, filtering every channel with every atom.

use std::ops::{Add, AddAssign, Mul};

use serde::{Deserialize, Serialize};

use crate::config::{Config, ConfigError, Form};
use crate::rdu::bank_size;

/// Parameters and multiply-adds of one part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Cost {
    /// Trained values; running statistics and fixed atoms are not counted.
    params: u64,
    /// Multiply-adds.
    macs: u64,
}

/// One module and its cost per exposure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModuleCost {
    /// Name of the module; the prefix of its weights, but for `rdu.bottleneck` (`rdu.bott`,
    /// `rdu.bott_rb`) and `rdu.head` (`rdu.head1`, `rdu.head2`).
    pub name: String,
    /// Trained values.
    pub params: u64,
    /// Multiply-adds per exposure of T steps, in units of 10^9.
    pub gmac: f64,
}

/// A configuration with its cost; the JSON of `config` is what the speed comparison reads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// The widths, in the paper's form whichever `form` is.
    pub config: Config,
    /// How depth enters and leaves.
    #[serde(default)]
    pub form: Form,
    /// Height and width the multiply-adds are counted for, in pixels.
    pub size: [usize; 2],
    /// Trained values in all.
    pub params: u64,
    /// Multiply-adds per exposure of T steps, in units of 10^9.
    pub gmac: f64,
    /// The parts, in the order data passes them.
    pub modules: Vec<ModuleCost>,
}

impl Add for Cost {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self {
            params: self.params + other.params,
            macs: self.macs + other.macs,
        }
    }
}

impl AddAssign for Cost {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

/// A count of equal blocks.
impl Mul<usize> for Cost {
    type Output = Self;
    fn mul(self, count: usize) -> Self {
        let count = count as u64;
        Self {
            params: self.params * count,
            macs: self.macs * count,
        }
    }
}

/// Describes `config` for pictures of `height` x `width` pixels.
pub fn describe(config: &Config, height: usize, width: usize) -> Result<Description, ConfigError> {
    config.validate()?;
    let grid = Grid {
        pixels: (height * width) as u64,
    };
    let steps = config.steps as u64;
    let mut parts = Vec::new();
    if config.has_efr() {
        parts.extend(efr(config, grid));
    }
    parts.extend(rdu(config, grid));
    #[allow(clippy::cast_precision_loss, reason = "far below 2^53")]
    let modules: Vec<ModuleCost> = parts
        .into_iter()
        .map(|(name, runs, cost)| {
            let times = match runs {
                Runs::Never => 0,
                Runs::Once => 1,
                Runs::EveryStep => steps,
                Runs::AfterTheFirst => steps - 1,
            };
            let gmac = (cost.macs * times) as f64 / 1e9;
            ModuleCost {
                name: name.into(),
                params: cost.params,
                gmac,
            }
        })
        .collect();
    Ok(Description {
        config: config.clone().with_form(Form::Direct),
        form: config.form,
        size: [height, width],
        params: modules.iter().map(|module| module.params).sum(),
        gmac: modules.iter().map(|module| module.gmac).sum(),
        modules,
    })
}

/// How often a module runs in one exposure.
#[derive(Clone, Copy)]
enum Runs {
    Never,
    Once,
    EveryStep,
    AfterTheFirst,
}

/// The pixels of the picture, from which those of every level follow.
#[derive(Clone, Copy)]
struct Grid {
    pixels: u64,
}

impl Grid {
    fn at(self, level: usize) -> u64 {
        self.pixels >> (2 * level)
    }

    /// A biased `k` x `k` convolution whose output lies at `level`.
    fn conv(self, k: usize, inputs: usize, outputs: usize, level: usize) -> Cost {
        let weights = (k * k * inputs * outputs) as u64;
        Cost {
            params: weights + outputs as u64,
            macs: weights * self.at(level),
        }
    }

    /// A convolution without bias and the two values per channel of its norm.
    fn conv_bn(self, k: usize, inputs: usize, outputs: usize, level: usize) -> Cost {
        self.conv(k, inputs, outputs, level)
            + Cost {
                params: outputs as u64,
                macs: 0,
            }
    }

    fn res_e(self, width: usize, level: usize) -> Cost {
        self.conv(3, width, width, level) * 2
    }

    fn res_d(self, width: usize, level: usize) -> Cost {
        self.conv_bn(3, width, width, level) * 2
    }

    /// Upsampling to `level`; its convolution runs one level below.
    fn up(self, inputs: usize, outputs: usize, level: usize) -> Cost {
        self.conv(1, inputs, 4 * outputs, level + 1)
    }
}

fn efr(config: &Config, grid: Grid) -> Vec<(&'static str, Runs, Cost)> {
    let [c0, c1, c2] = config.c;
    let [k1, k2] = config.k;
    let (cd, n1, n2) = (config.cd, config.n1, config.n2);
    let spatial = grid.conv(3, 3, c0, 0)
        + grid.res_e(c0, 0) * config.n_sp[0]
        + grid.conv(3, c0, c1, 1)
        + grid.res_e(c1, 1) * config.n_sp[1]
        + grid.conv(3, c1, c2, 2)
        + grid.res_e(c2, 2) * config.n_sp[2]
        + grid.conv(1, c2, c1, 2)
        + grid.conv(1, c1, c0, 1)
        + grid.conv(3, c0, c0, 0);
    let temporal = grid.conv(3, config.bins, k1, 1)
        + grid.conv(3, k1, k2, 2)
        + grid.res_e(k2, 2) * config.n_t
        + grid.conv(1, k2 + 6 * config.freqs, cd, 2)
        + grid.conv(1, cd, cd, 2) * 2;
    let film = grid.conv(3, cd, cd, 2) + grid.conv(1, cd, c2, 2) * 2;
    let fuse = grid.conv(3, 2 * c0, c0, 0) + grid.conv(3, c0, c0, 0);
    let enc1 = grid.conv(3, c0, c1, 1) + grid.res_e(c1, 1) * n1;
    let enc2 = grid.conv(3, c1, c2, 2) + grid.res_e(c2, 2) * n2;
    let dec1 = grid.res_e(c2, 2) * n2 + grid.up(c2, c1, 1);
    let dec2 = grid.conv(3, 2 * c1, c1, 1)
        + grid.res_e(c1, 1) * n1
        + grid.up(c1, c0, 0)
        + grid.conv(3, c0, c0, 0);
    let recon = grid.conv(3, c0, c0, 0) + grid.conv(3, c0, 3, 0);
    vec![
        ("efr.spatial", Runs::Once, spatial),
        ("efr.fuse", Runs::AfterTheFirst, fuse),
        ("efr.enc1", Runs::EveryStep, enc1),
        ("efr.enc2", Runs::EveryStep, enc2),
        ("efr.temporal", Runs::EveryStep, temporal),
        ("efr.film", Runs::EveryStep, film),
        ("efr.dec1", Runs::EveryStep, dec1),
        ("efr.dec2", Runs::EveryStep, dec2),
        ("efr.recon", Runs::Never, recon),
    ]
}

fn rdu(config: &Config, grid: Grid) -> Vec<(&'static str, Runs, Cost)> {
    let (c0, d) = (config.c[0], config.d);
    let mut parts = Vec::new();
    if !config.has_efr() {
        parts.push(("rdu.rgb_stem", Runs::Once, grid.conv(3, 3, c0, 0)));
    }
    let guide = grid.conv_bn(3, c0, config.g[0], 0) + levels(grid, &config.g, &config.n_g);
    parts.push(("rdu.guide", Runs::EveryStep, guide));
    if config.has_event_pyramid() {
        let stem = grid.conv_bn(3, config.bins, config.e[0], 0);
        let event = stem + levels(grid, &config.e, &config.n_e);
        parts.push(("rdu.event", Runs::EveryStep, event));
    }
    let depth = grid.conv(5, config.form.depth_channels(), d[0], 0) + levels(grid, &d, &config.n_d);
    parts.push(("rdu.depth", Runs::EveryStep, depth));
    let joined = d[4] + config.guidance_width(4);
    let bottleneck = grid.conv_bn(1, joined, d[4], 4) + grid.res_d(d[4], 4) * config.n_b;
    parts.push(("rdu.bottleneck", Runs::EveryStep, bottleneck));
    for (level, name) in ["rdu.dec0", "rdu.dec1", "rdu.dec2", "rdu.dec3"]
        .into_iter()
        .enumerate()
        .rev()
    {
        parts.push((name, Runs::EveryStep, decoder(config, grid, level)));
    }
    let head = grid.conv(3, d[0], d[0], 0) + grid.conv(3, d[0], config.form.head_channels(), 0);
    parts.push(("rdu.head", Runs::EveryStep, head));
    parts
}

/// All of a pyramid but its stem.
fn levels(grid: Grid, widths: &[usize; 5], blocks: &[usize; 5]) -> Cost {
    let mut cost = grid.res_d(widths[0], 0) * blocks[0];
    for l in 1..5 {
        cost += grid.conv_bn(3, widths[l - 1], widths[l], l) + grid.res_d(widths[l], l) * blocks[l];
    }
    cost
}

fn decoder(config: &Config, grid: Grid, level: usize) -> Cost {
    let (d, m) = (config.d[level], config.filters);
    let guided = d + config.guidance_width(level);
    let (atoms, side) = bank_size(level);
    let filtering = (d * atoms * side * side + d * atoms * m) as u64 * grid.at(level);
    grid.up(config.d[level + 1], d, level)
        + grid.conv_bn(3, 2 * d, d, level)
        + grid.res_d(d, level) * config.n_u[level]
        + grid.conv(3, guided, 1, level)
        + grid.conv(3, guided, d, level)
        + grid.conv(1, d, m * atoms, level)
        + Cost {
            params: 0,
            macs: filtering,
        }
        + grid.conv(1, d * m, d, level)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Variant;
    use crate::params::Role;
    use crate::parts::slots;

    fn round(value: f64, digits: i32) -> f64 {
        let unit = 10f64.powi(digits);
        (value * unit).round() / unit
    }

    /// The family's published figures: parameters in millions, multiply-adds per exposure.
    #[test]
    fn the_family_costs_what_its_table_says() {
        for (name, params, gmac) in [
            ("full", 29.693, 347.36),
            ("s", 2.146, 44.24),
            ("xs", 0.572, 14.02),
        ] {
            let description = describe(&Config::member(name).unwrap(), 256, 256).unwrap();
            #[allow(clippy::cast_precision_loss, reason = "far below 2^53")]
            let millions = description.params as f64 / 1e6;
            assert_eq!(
                (round(millions, 3), round(description.gmac, 2)),
                (params, gmac),
                "{name}"
            );
        }
    }

    #[test]
    fn the_full_network_splits_as_its_table_says() {
        let description = describe(&Config::full(), 256, 256).unwrap();
        let wanted = [
            ("efr.spatial", 9.8),
            ("efr.fuse", 12.7),
            ("efr.enc1", 21.7),
            ("efr.enc2", 41.1),
            ("efr.temporal", 7.1),
            ("efr.film", 5.9),
            ("efr.dec1", 39.7),
            ("efr.dec2", 34.9),
            ("efr.recon", 0.0),
            ("rdu.guide", 43.3),
            ("rdu.event", 5.0),
            ("rdu.depth", 34.5),
            ("rdu.bottleneck", 11.6),
            ("rdu.dec3", 21.6),
            ("rdu.dec2", 15.4),
            ("rdu.dec1", 17.0),
            ("rdu.dec0", 23.3),
            ("rdu.head", 2.8),
        ];
        assert_eq!(description.modules.len(), wanted.len());
        for (module, (name, gmac)) in description.modules.iter().zip(wanted) {
            assert_eq!(module.name, name);
            // The table was rounded twice: 4.946 stands in it as 5.0.
            assert!(
                (module.gmac - gmac).abs() < 0.055,
                "{name}: {}",
                module.gmac
            );
        }
    }

    /// The second route: the tensors the network itself asks for.
    #[test]
    fn counted_parameters_are_those_the_network_asks_for() {
        for member in ["full", "s", "xs", "tiny"] {
            for variant in [Variant::Full, Variant::NoEfr, Variant::NoHgcm] {
                let config = Config::member(member).unwrap().with_variant(variant);
                let slots = slots(&config).unwrap();
                for module in describe(&config, 64, 32).unwrap().modules {
                    let prefix = match module.name.as_str() {
                        "rdu.bottleneck" => "rdu.bott".into(),
                        "rdu.head" => "rdu.head".into(),
                        name => format!("{name}."),
                    };
                    let asked: usize = slots
                        .iter()
                        .filter(|s| s.role == Role::Trained && s.name.starts_with(&prefix))
                        .map(crate::Slot::len)
                        .sum();
                    assert_eq!(module.params, asked as u64, "{member} {variant:?} {prefix}");
                }
            }
        }
    }

    #[test]
    fn a_description_survives_json_and_its_config_is_the_oracles_form() {
        let description = describe(&Config::xs(), 256, 256).unwrap();
        let json = serde_json::to_string(&description).unwrap();
        let read: Description = serde_json::from_str(&json).unwrap();
        assert_eq!(read.config.with_form(read.form), Config::xs());
        assert_eq!(read.modules.len(), 18);
        assert!(json.contains("\"n_sp\":[0,1,1]"), "{json}");
    }
}
