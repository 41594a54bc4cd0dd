//! Rigid transforms between frames of reference, as plain numbers.

use serde::{Deserialize, Serialize};

use crate::FieldError;

/// How far a rotation may be from orthonormal.
const ORTHONORMAL_TOLERANCE: f64 = 1e-6;

/// A rigid transform `target_from_source`: `p_target = rotation * p_source + translation_m`.
///
/// In TOML the rotation is either `rotation` (3x3, row by row) or `quaternion_wxyz` (unit, w
/// first); it is always written as the former.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "PoseText")]
pub struct Pose {
    /// Row-major rotation matrix.
    pub rotation: [[f64; 3]; 3],
    /// Origin of the source frame in the target frame, metres.
    pub translation_m: [f64; 3],
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseText {
    rotation: Option<[[f64; 3]; 3]>,
    quaternion_wxyz: Option<[f64; 4]>,
    translation_m: [f64; 3],
}

impl TryFrom<PoseText> for Pose {
    type Error = String;

    fn try_from(text: PoseText) -> Result<Self, String> {
        let rotation = match (text.rotation, text.quaternion_wxyz) {
            (Some(rotation), None) => rotation,
            (None, Some(quaternion)) => matrix(quaternion)?,
            _ => return Err("exactly one of rotation and quaternion_wxyz is needed".to_owned()),
        };
        Ok(Self {
            rotation,
            translation_m: text.translation_m,
        })
    }
}

fn matrix(quaternion: [f64; 4]) -> Result<[[f64; 3]; 3], String> {
    let norm = quaternion.iter().map(|v| v * v).sum::<f64>().sqrt();
    if norm.is_nan() || (norm - 1.0).abs() > ORTHONORMAL_TOLERANCE {
        return Err(format!("quaternion_wxyz has length {norm}, needs 1"));
    }
    let [w, x, y, z] = quaternion.map(|v| v / norm);
    Ok([
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ])
}

impl Pose {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self {
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        translation_m: [0.0; 3],
    };

    /// A point of the source frame (metres), in the target frame.
    #[must_use]
    pub fn apply(&self, point_m: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| dot(self.rotation[i], point_m) + self.translation_m[i])
    }

    /// `source_from_target`.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = transpose(self.rotation);
        Self {
            rotation,
            translation_m: rotation.map(|row| -dot(row, self.translation_m)),
        }
    }

    /// `target_from_inner`, when `inner` is `source_from_inner`.
    #[must_use]
    pub fn compose(&self, inner: &Self) -> Self {
        let columns = transpose(inner.rotation);
        Self {
            rotation: self
                .rotation
                .map(|row| columns.map(|column| dot(row, column))),
            translation_m: self.apply(inner.translation_m),
        }
    }

    /// Checks that the rotation is one and every number finite.
    ///
    /// # Errors
    /// Names the field and what is wrong with it.
    pub(crate) fn validate(&self) -> Result<(), FieldError> {
        let translation = self.translation_m;
        if !translation.iter().all(|v| v.is_finite()) {
            let value = format!("{translation:?}");
            return Err(FieldError::new("translation_m", value, "not finite"));
        }
        let rotation = self.rotation;
        let bad = |problem| FieldError::new("rotation", format!("{rotation:?}"), problem);
        for i in 0..3 {
            for j in 0..3 {
                let unit = f64::from(u8::from(i == j));
                let error = dot(rotation[i], rotation[j]) - unit;
                if error.is_nan() || error.abs() > ORTHONORMAL_TOLERANCE {
                    return Err(bad("rows are not orthonormal within 1e-6"));
                }
            }
        }
        if dot(cross(rotation[0], rotation[1]), rotation[2]) < 0.0 {
            return Err(bad("mirrors space (determinant -1)"));
        }
        Ok(())
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

fn transpose(m: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|j| m[j][i]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Pose, toml::de::Error> {
        toml::from_str(text)
    }

    /// A quarter turn about z takes x to y.
    #[test]
    fn a_quaternion_and_its_matrix_are_the_same_rotation() {
        let half = 0.5f64.sqrt();
        let text = format!(
            "quaternion_wxyz = [{half}, 0.0, 0.0, {half}]\ntranslation_m = [1.0, 2.0, 3.0]"
        );
        let pose = parse(&text).unwrap();
        let point = pose.apply([1.0, 0.0, 0.0]);
        for (value, expected) in point.into_iter().zip([1.0, 3.0, 3.0]) {
            assert!((value - expected).abs() < 1e-12);
        }
        assert_eq!(pose.validate(), Ok(()));
    }

    #[test]
    fn a_pose_and_its_inverse_cancel() {
        let pose =
            parse("quaternion_wxyz = [0.5, 0.5, -0.5, 0.5]\ntranslation_m = [1.0, -2.0, 3.0]")
                .unwrap();
        let both = pose.compose(&pose.inverse());
        for i in 0..3 {
            assert!(both.translation_m[i].abs() < 1e-12);
            for j in 0..3 {
                let unit = Pose::IDENTITY.rotation[i][j];
                assert!((both.rotation[i][j] - unit).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn rotations_that_are_none_are_refused() {
        let edit = |change: fn(&mut Pose)| {
            let mut pose = Pose::IDENTITY;
            change(&mut pose);
            pose.validate().unwrap_err().to_string()
        };
        assert!(edit(|p| p.rotation[0][0] = 1.000_01).ends_with("orthonormal within 1e-6"));
        assert!(edit(|p| p.rotation[1][0] = f64::NAN).ends_with("orthonormal within 1e-6"));
        assert!(edit(|p| p.rotation[2][2] = -1.0).ends_with("(determinant -1)"));
        assert!(edit(|p| p.translation_m[1] = f64::INFINITY).starts_with("translation_m"));
        let both = "rotation = [[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]\n\
                    quaternion_wxyz = [1.0,0.0,0.0,0.0]\ntranslation_m = [0.0,0.0,0.0]";
        assert!(parse(both).is_err());
        assert!(parse("translation_m = [0.0,0.0,0.0]").is_err());
        let long = "quaternion_wxyz = [2.0,0.0,0.0,0.0]\ntranslation_m = [0.0,0.0,0.0]";
        let error = parse(long).unwrap_err().to_string();
        assert!(
            error.contains("quaternion_wxyz has length 2, needs 1"),
            "{error}"
        );
    }
}
