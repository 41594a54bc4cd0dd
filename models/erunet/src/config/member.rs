//! The members of the family: the paper's widths, and ours for two processor cores.

use super::{Config, ConfigError, Form, Variant, default_bins, default_depth_max, default_freqs};

impl Config {
    /// The paper's network: 29.69 M parameters.
    pub fn full() -> Self {
        Self {
            name: "full".into(),
            c: [32, 64, 128],
            n_sp: [1, 2, 4],
            n1: 2,
            n2: 4,
            k: [32, 64],
            n_t: 2,
            cd: 128,
            g: [32, 48, 96, 192, 384],
            e: [16, 24, 32, 80, 128],
            d: [24, 40, 80, 192, 384],
            n_g: [0, 1, 1, 2, 2],
            n_e: [0, 1, 1, 1, 1],
            n_d: [0, 1, 1, 2, 2],
            n_b: 2,
            n_u: [1, 1, 1, 1],
            filters: 6,
            ..Self::tiny()
        }
        .with_steps(8)
    }

    /// The larger of the two small members, for two processor cores: see the family's table.
    pub fn s() -> Self {
        Self {
            name: "s".into(),
            c: [16, 32, 48],
            n_sp: [0, 1, 1],
            n1: 1,
            n2: 1,
            k: [16, 32],
            n_t: 1,
            cd: 32,
            g: [16, 16, 32, 64, 128],
            e: [8, 8, 16, 32, 64],
            d: [16, 16, 32, 64, 128],
            n_g: [0, 0, 1, 1, 1],
            n_e: [0, 0, 1, 1, 1],
            n_d: [0, 0, 1, 1, 1],
            n_b: 1,
            n_u: [0, 1, 1, 1],
            filters: 4,
            form: Form::Choice,
            ..Self::tiny()
        }
        .with_steps(8)
    }

    /// The smallest member that ships: see the family's table.
    pub fn xs() -> Self {
        Self {
            name: "xs".into(),
            c: [8, 16, 32],
            n_sp: [0, 1, 1],
            n1: 1,
            n2: 1,
            k: [8, 16],
            n_t: 1,
            cd: 16,
            g: [8, 16, 16, 32, 64],
            e: [4, 8, 8, 16, 32],
            d: [8, 16, 16, 32, 64],
            n_g: [0, 0, 1, 1, 1],
            n_e: [0, 0, 0, 1, 1],
            n_d: [0, 0, 0, 1, 1],
            n_b: 1,
            n_u: [0, 0, 1, 1],
            filters: 2,
            form: Form::Choice,
            ..Self::tiny()
        }
        .with_steps(8)
    }

    /// The smallest network with every part present, for tests; three steps.
    pub fn tiny() -> Self {
        Self {
            name: "tiny".into(),
            c: [4, 6, 8],
            n_sp: [1, 1, 1],
            n1: 1,
            n2: 1,
            k: [4, 6],
            n_t: 1,
            cd: 8,
            g: [4, 6, 8, 10, 12],
            e: [2, 4, 4, 6, 6],
            d: [4, 6, 8, 10, 12],
            n_g: [1; 5],
            n_e: [1; 5],
            n_d: [1; 5],
            n_b: 1,
            n_u: [1; 4],
            filters: 3,
            bins: default_bins(),
            freqs: default_freqs(),
            steps: 3,
            d_max: default_depth_max(),
            variant: Variant::Full,
            form: Form::Direct,
        }
    }

    /// The member of the family called `name`: `full`, `s`, `xs` or `tiny`.
    pub fn member(name: &str) -> Result<Self, ConfigError> {
        match name {
            "full" => Ok(Self::full()),
            "s" => Ok(Self::s()),
            "xs" => Ok(Self::xs()),
            "tiny" => Ok(Self::tiny()),
            other => Err(ConfigError::UnknownMember(other.into())),
        }
    }
}
