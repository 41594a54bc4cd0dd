//! The mean of two networks' weights.
//!
//! Two legs of one training lie near enough to each other that what lies between them is a network
//! too, often a better one than either where they trade one kind of error for another (weight
//! averaging, Izmailov et al. 2018; Wortsman et al. 2022 for legs that part from one start).

use candle_core::Tensor;

use crate::config::Config;
use crate::params::Role;
use crate::parts::slots;
use crate::weights::{Weights, WeightsError};

impl Weights {
    /// `1 - share` of these weights and `share` of `other`'s, value by value; running statistics
    /// are mixed like the rest, what never changes is kept.
    ///
    /// # Errors
    /// [`WeightsError::Mix`] when `share` is not within 0 to 1 or the files are not of one
    /// network; [`WeightsError::Faults`] when one of them is not whole.
    pub fn mixed(&self, other: &Self, share: f64) -> Result<Self, WeightsError> {
        if !(0.0..=1.0).contains(&share) {
            return Err(WeightsError::Mix(format!("share {share}, allowed 0 to 1")));
        }
        let config = one_network(self.config(), other.config()).map_err(WeightsError::Mix)?;
        self.check(config)?;
        other.check(config)?;
        let mut tensors = self.tensors().clone();
        for slot in slots(config)? {
            let own = &self.tensors()[&slot.name];
            if slot.role != Role::Fixed {
                let mixed = between(own, &other.tensors()[&slot.name], share)?;
                tensors.insert(slot.name, mixed);
            }
        }
        Self::from_tensors(config, tensors, &self.device())
    }
}

/// Exactly one of the two at shares 0 and 1.
fn between(own: &Tensor, other: &Tensor, share: f64) -> candle_core::Result<Tensor> {
    let other = other.to_device(own.device())?;
    (own * (1.0 - share))? + (other * share)?
}

/// The configuration both were written with.
fn one_network<'a>(own: Option<&'a Config>, other: Option<&Config>) -> Result<&'a Config, String> {
    let (Some(own), Some(other)) = (own, other) else {
        return Err("a file does not say which network it is of".into());
    };
    if own == other {
        return Ok(own);
    }
    let (own, other) = (own.to_json(), other.to_json());
    Err(format!("files are of two networks, {own} and {other}"))
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;

    fn start(config: &Config, seed: u32) -> Weights {
        Weights::initial(config, seed, &Device::Cpu).unwrap()
    }

    fn values(weights: &Weights, name: &str) -> Vec<f32> {
        let flat = weights.tensors()[name].flatten_all().unwrap();
        flat.to_vec1().unwrap()
    }

    #[test]
    fn every_value_lies_where_the_share_says() {
        let config = Config::tiny();
        let (a, b) = (start(&config, 1), start(&config, 2));
        let mixed = a.mixed(&b, 0.25).unwrap();
        let mut moved = 0;
        for name in a.tensors().keys() {
            let (a, b) = (values(&a, name), values(&b, name));
            for ((a, b), mixed) in a.iter().zip(&b).zip(values(&mixed, name)) {
                assert!((0.75 * a + 0.25 * b - mixed).abs() < 1e-6, "{name}");
                moved += usize::from((a - mixed).abs() > 1e-6);
            }
        }
        assert!(moved > 1000, "two seeds differ");
        let (first, last) = (a.mixed(&b, 0.0).unwrap(), a.mixed(&b, 1.0).unwrap());
        for name in a.tensors().keys() {
            assert!(values(&first, name) == values(&a, name), "{name}");
            assert!(values(&last, name) == values(&b, name), "{name}");
        }
    }

    #[test]
    fn what_cannot_be_mixed_is_refused() {
        let a = start(&Config::tiny(), 1);
        let error = |other: &Weights, share| a.mixed(other, share).unwrap_err().to_string();
        assert!(error(&a, 1.5).contains("share 1.5, allowed 0 to 1"));
        assert!(error(&a, f64::NAN).contains("allowed 0 to 1"));
        let longer = start(&Config::tiny().with_steps(4), 1);
        let two = error(&longer, 0.5);
        assert!(two.contains("\"T\":3") && two.contains("\"T\":4"), "{two}");
    }
}
