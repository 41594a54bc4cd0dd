//! What a network is built from: its two parts, and the tensors they ask for.

use crate::config::{Config, ConfigError};
use crate::efr::Efr;
use crate::params::{Norms, Params, Slot, Source};
use crate::rdu::Rdu;

/// Every tensor a network of this configuration wants in its weights file, in building order.
pub fn slots(config: &Config) -> Result<Vec<Slot>, ConfigError> {
    config.validate()?;
    let source = Source::Recording(Vec::new().into());
    let root = Params::root(&source, Norms::Keep);
    build(config, &root).expect("recording needs one value per tensor and no input");
    let Source::Recording(slots) = source else {
        unreachable!("the source is made above")
    };
    Ok(slots.into_inner())
}

/// Restoration, where the configuration has any, and completion.
pub(crate) fn build(config: &Config, root: &Params<'_>) -> candle_core::Result<(Option<Efr>, Rdu)> {
    let efr = config
        .has_efr()
        .then(|| Efr::new(&root.at("efr"), config))
        .transpose()?;
    Ok((efr, Rdu::new(&root.at("rdu"), config)?))
}
