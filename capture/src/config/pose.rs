//! Poses in rig files.

use super::key::{Key, keys};
use super::section::Section;
use kinematics::Transform;
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use toml::Value;

/// Larger coordinates of poses and lenses are considered typing errors.
pub(super) const MAX_COORDINATE: f64 = 1e4;
/// A quaternion whose length deviates from 1 by less than this is not normalized, so that an
/// effective rig file gives exactly the same rig.
const UNIT_NORM_TOLERANCE: f64 = 1e-12;

keys! {
    /// The keys of a pose.
    struct PoseKeys {
        /// Position, meters.
        xyz_m: [f64; 3] = [0.0; 3], in -MAX_COORDINATE..=MAX_COORDINATE;
        /// Orientation as a unit quaternion. Its real part comes last.
        quat_xyzw: [f64; 4] = [0.0, 0.0, 0.0, 1.0], in -1.001..=1.001;
    }
}

impl Key for Transform {
    type Limits = ();

    fn read(keys: &mut Section<'_>, key: &'static str, (): ()) -> Option<Self> {
        let PoseKeys {
            xyz_m: [x, y, z],
            quat_xyzw: [i, j, k, w],
        } = keys.get(key, ())?;
        let quaternion = Quaternion::new(w, i, j, k);
        let norm = quaternion.norm();
        // Quaternions that are rounded to three or more digits pass. A larger deviation is a sign
        // of a typing error or of another convention, such as Euler angles.
        if (norm - 1.0).abs() > 1e-3 {
            let got = Value::from(vec![i, j, k, w]);
            return keys.invalid(
                &format!("{key}.quat_xyzw"),
                &got,
                "numbers whose squares sum to 1",
            );
        }
        let rotation = if (norm - 1.0).abs() < UNIT_NORM_TOLERANCE {
            UnitQuaternion::new_unchecked(quaternion)
        } else {
            UnitQuaternion::new_normalize(quaternion)
        };
        Some(Self::from_parts(Translation3::new(x, y, z), rotation))
    }

    fn write(&self) -> Option<Value> {
        let Quaternion { coords } = *self.rotation.quaternion();
        PoseKeys {
            xyz_m: self.translation.vector.into(),
            quat_xyzw: coords.into(),
        }
        .write()
    }

    fn schema((): ()) -> serde_json::Value {
        PoseKeys::schema(())
    }
}
