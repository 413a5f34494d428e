//! Corrected keyframes whose robot masks were drawn again in the background, so that training does
//! not wait for them.

use crate::registration::Alignment;
use keyframe::Keyframe;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Corrected keyframes in which a robot is masked.
#[derive(Debug, Default)]
pub(crate) struct RedrawnKeyframes {
    /// Number of camera movements that the corrections contain.
    n_movements: usize,
    /// By camera and stamp.
    keyframes: BTreeMap<(Arc<str>, i64), Redrawn>,
}

#[derive(Debug)]
struct Redrawn {
    original: Arc<Keyframe>,
    corrected: Arc<Keyframe>,
}

impl RedrawnKeyframes {
    /// Corrects the keyframes in which a robot is masked.
    pub(crate) fn new(alignment: &Alignment, originals: &[Arc<Keyframe>]) -> Self {
        let masked = originals
            .par_iter()
            .filter(|original| original.robot.is_some());
        let redrawn = masked.map(|original| {
            let id = (Arc::clone(&original.camera), original.stamp.0);
            let redrawn = Redrawn {
                original: Arc::clone(original),
                corrected: alignment.corrected(original),
            };
            (id, redrawn)
        });
        Self {
            n_movements: alignment.movements.len(),
            keyframes: redrawn.collect(),
        }
    }

    /// These keyframes, or none if movements of cameras were found since they were corrected.
    pub(crate) fn if_valid_for(self, alignment: &Alignment) -> Self {
        if alignment.movements.len() == self.n_movements {
            self
        } else {
            Self::default()
        }
    }

    /// The corrected version of a keyframe; `None` if it was not drawn.
    pub(crate) fn of(&self, original: &Arc<Keyframe>) -> Option<Arc<Keyframe>> {
        if self.keyframes.is_empty() {
            return None;
        }
        let redrawn = self
            .keyframes
            .get(&(Arc::clone(&original.camera), original.stamp.0))?;
        // The pose of a keyframe may have been corrected in another way since.
        Arc::ptr_eq(&redrawn.original, original).then(|| Arc::clone(&redrawn.corrected))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CameraCorrection;
    use crate::scenes::{Miscalibration, capture};
    use keyframe::MaskViews;
    use keyframe::masked_robot::{HiddenPixels, MaskedRobot, Sweep, Uncertainty};
    use kinematics::Transform;
    use nalgebra::Point3;

    /// A keyframe with depth that shows a robot of one triangle in front of its camera.
    fn masked_keyframe() -> Arc<Keyframe> {
        let keyframes = capture(&Miscalibration::none());
        let mut keyframe = (*keyframes[0]).clone();
        let sweep = Sweep {
            link_ix: 0,
            camera_from_link: vec![Transform::translation(0.003, -0.002, 1.07)],
        };
        // No edge is at the border of a cell, where rounding could change the mask.
        let corners = [
            [-0.1013, -0.0977, 0.0],
            [0.1041, -0.0977, 0.0],
            [0.0, 0.1019, 0.0],
        ];
        let robot = MaskedRobot {
            links: Arc::new([vec![corners.map(Point3::from).to_vec()]]),
            uncertainty: Uncertainty {
                rotation_rad: 0.0,
                position_m: 0.0,
            },
            during_color: vec![sweep.clone()],
            during_depth: vec![sweep],
            camera_from_depth: Transform::identity(),
            hidden: HiddenPixels::default(),
        };
        let views = MaskViews::of(&keyframe);
        assert!(keyframe.mask_robot(robot, &views) > 0);
        Arc::new(keyframe)
    }

    fn alignment_of(keyframe: &Keyframe, correction: CameraCorrection) -> Alignment {
        Alignment {
            corrections: BTreeMap::from([(keyframe.camera.to_string(), correction)]),
            ..Alignment::default()
        }
    }

    /// The sum of the known depth readings and of those that a mask hides, meters.
    fn all_readings_m(keyframe: &Keyframe) -> f64 {
        let depth = keyframe.depth.as_ref().expect("depth");
        let hidden = &keyframe.robot.as_ref().expect("a robot").hidden.depth_m;
        let all = depth.depth_m.iter().chain(hidden);
        all.map(|reading| f64::from(*reading)).sum()
    }

    #[test]
    fn corrected_extrinsics_move_the_mask() {
        let original = masked_keyframe();
        let correction = CameraCorrection {
            rotation_rad: [0.0, 0.15, 0.0],
            translation_m: [0.01, 0.0, 0.0],
            ..CameraCorrection::default()
        };
        let alignment = alignment_of(&original, correction.clone());
        let corrected = alignment.corrected(&original);
        let moved = alignment.moved(&original);
        let remasked = alignment.remasked(&original);
        assert!(corrected.rgba_srgb != original.rgba_srgb);
        assert_eq!(corrected.world_from_camera, moved.world_from_camera);
        assert!(Arc::ptr_eq(&moved.rgba_srgb, &original.rgba_srgb));
        assert_eq!(remasked.world_from_camera, original.world_from_camera);
        assert!(remasked.rgba_srgb == corrected.rgba_srgb);
        // The inverse correction restores the mask.
        let inverse = Transform::from_parts(
            nalgebra::Vector3::from(correction.translation_m).into(),
            nalgebra::UnitQuaternion::from_scaled_axis(correction.rotation_rad.into()),
        )
        .inverse();
        let back = CameraCorrection {
            rotation_rad: inverse.rotation.scaled_axis().into(),
            translation_m: inverse.translation.vector.into(),
            ..CameraCorrection::default()
        };
        let restored = back.corrected(&corrected);
        let n_different = restored
            .rgba_srgb
            .iter()
            .zip(&*original.rgba_srgb)
            .filter(|(one, other)| one != other)
            .count();
        // A cell at an edge may change by rounding.
        assert!(n_different < 20, "{n_different}");
    }

    #[test]
    fn corrections_that_do_not_move_the_robot_keep_the_pixels() {
        let original = masked_keyframe();
        let correction = CameraCorrection {
            time_offset_secs: 0.01,
            log_depth_scale: 0.1,
            ..CameraCorrection::default()
        };
        let corrected = alignment_of(&original, correction).corrected(&original);
        assert!(Arc::ptr_eq(&corrected.rgba_srgb, &original.rgba_srgb));
        // Readings that the mask hides are scaled, too, because another correction may show them.
        let ratio = all_readings_m(&corrected) / all_readings_m(&original);
        assert!((ratio - 0.1_f64.exp()).abs() < 1e-5, "{ratio}");
    }

    #[test]
    fn a_corrected_lens_scales_the_mask() {
        let original = masked_keyframe();
        let n_masked = |keyframe: &Keyframe| {
            let runs = &keyframe.robot.as_ref().expect("a robot").hidden.color;
            runs.iter().map(|[_, n]| n).sum::<u32>()
        };
        let correction = CameraCorrection {
            log_focal: [0.3; 2],
            ..CameraCorrection::default()
        };
        let corrected = alignment_of(&original, correction).corrected(&original);
        assert!(n_masked(&corrected) > n_masked(&original));
    }

    #[test]
    fn keyframes_are_redrawn_only_for_the_same_original() {
        let original = masked_keyframe();
        let correction = CameraCorrection {
            rotation_rad: [0.0, 0.15, 0.0],
            ..CameraCorrection::default()
        };
        let alignment = alignment_of(&original, correction);
        let unmasked = capture(&Miscalibration::none()).remove(1);
        let redrawn = RedrawnKeyframes::new(&alignment, &[original.clone(), unmasked.clone()]);
        let found = redrawn.of(&original).expect("it was drawn");
        assert!(found.rgba_srgb == alignment.corrected(&original).rgba_srgb);
        assert!(redrawn.of(&unmasked).is_none(), "it has no mask");
        let other = Arc::new((*original).clone());
        assert!(redrawn.of(&other).is_none(), "it may have another pose");
        let redrawn = redrawn.if_valid_for(&alignment);
        assert!(redrawn.of(&original).is_some());
    }
}
