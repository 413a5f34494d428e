//! Distance between poses, in units of the minimum distance between keyframes.

use kinematics::Transform;

/// The translation and rotation that count as distance 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Spacing {
    pub(super) translation_m: f64,
    pub(super) rotation_rad: f64,
}

impl Spacing {
    /// The larger of translation and rotation, each divided by its unit. A new keyframe needs at
    /// least 1.
    pub(super) fn between(&self, a: &Transform, b: &Transform) -> f64 {
        let translation_m = (a.translation.vector - b.translation.vector).norm();
        // The maximum is used instead of the sum, because one of the two kinds of motion alone must
        // be large enough to show something new.
        (translation_m / self.translation_m)
            .max(a.rotation.angle_to(&b.rotation) / self.rotation_rad)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn spacing_is_the_larger_of_translation_and_rotation() {
        let spacing = Spacing {
            translation_m: 0.02,
            rotation_rad: 0.1,
        };
        let at = |x, angle_rad| {
            Transform::new(Vector3::new(x, 0.0, 0.0), Vector3::new(0.0, angle_rad, 0.0))
        };
        for (x, angle_rad, expected) in [
            (0.0, 0.0, 0.0),
            (0.01, 0.0, 0.5),
            (0.01, 0.2, 2.0),
            (0.06, 0.2, 3.0),
        ] {
            assert!(
                (spacing.between(&at(1.0, 1.0), &at(1.0 + x, 1.0 + angle_rad)) - expected).abs()
                    < 1e-9
            );
        }
    }
}
