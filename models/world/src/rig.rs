//! Where the sensors sit on the vehicle.

/// Rotation matrix, row-major.
type Rotation = [[f64; 3]; 3];

/// Small mounting angles of the LiDAR about the camera's x, y and z axes, degrees, so that no
/// extrinsic is a plain exchange of axes.
const MOUNTING_DEG: [f64; 3] = [-0.4, 0.6, 0.3];
/// The LiDAR's origin in the camera's frame: 0.25 m above, 0.10 m behind.
const LIDAR_M: [f64; 3] = [0.0, -0.25, -0.10];

/// Rigid transform from the LiDAR's frame (x right, y forward, z up) to the camera's (x right,
/// y down, z forward), metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mounting {
    /// Rotation, row-major.
    pub rotation: Rotation,
    /// Position of the LiDAR in the camera's frame.
    pub translation_m: [f64; 3],
}

impl Mounting {
    /// The default rig's `camera_from_lidar`.
    #[must_use]
    pub fn camera_from_lidar() -> Self {
        let [x, y, z] = MOUNTING_DEG.map(f64::to_radians);
        let axes = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]];
        let tilt = product(&about(2, z), &product(&about(1, y), &about(0, x)));
        Self {
            rotation: product(&tilt, &axes),
            translation_m: LIDAR_M,
        }
    }

    /// A direction in the LiDAR's frame, in the camera's.
    #[must_use]
    pub fn rotate(&self, v: [f64; 3]) -> [f64; 3] {
        self.rotation
            .map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
    }

    /// A point in the LiDAR's frame, in the camera's.
    #[must_use]
    pub fn apply(&self, p: [f64; 3]) -> [f64; 3] {
        let turned = self.rotate(p);
        core::array::from_fn(|i| turned[i] + self.translation_m[i])
    }

    /// As a 4 by 4 matrix, row-major.
    #[must_use]
    pub fn to_matrix(&self) -> [[f64; 4]; 4] {
        let row = |i: usize| {
            let r = self.rotation[i];
            [r[0], r[1], r[2], self.translation_m[i]]
        };
        [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
    }
}

/// Rotation about axis 0, 1 or 2 by `angle` radians.
fn about(axis: usize, angle: f64) -> Rotation {
    let (sin, cos) = angle.sin_cos();
    let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
    let mut r = [[0.0; 3]; 3];
    r[axis][axis] = 1.0;
    r[i][i] = cos;
    r[j][j] = cos;
    r[i][j] = -sin;
    r[j][i] = sin;
    r
}

fn product(a: &Rotation, b: &Rotation) -> Rotation {
    core::array::from_fn(|i| core::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forward_and_up_of_the_lidar_are_nearly_forward_and_up_of_the_camera() {
        let mounting = Mounting::camera_from_lidar();
        let ahead = mounting.apply([0.0, 10.0, 0.0]);
        assert!(
            (ahead[2] - 9.9).abs() < 0.01 && ahead[0].abs() > 0.05 && ahead[0].abs() < 0.2,
            "{ahead:?}"
        );
        let up = mounting.rotate([0.0, 0.0, 1.0]);
        assert!(up[1] < -0.999);
        let r = mounting.rotation;
        let determinant: f64 = (0..3)
            .map(|i| {
                r[0][i]
                    * (r[1][(i + 1) % 3] * r[2][(i + 2) % 3]
                        - r[1][(i + 2) % 3] * r[2][(i + 1) % 3])
            })
            .sum();
        assert!((determinant - 1.0).abs() < 1e-12);
    }
}
