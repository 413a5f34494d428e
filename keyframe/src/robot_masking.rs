//! Masks the robot in a keyframe, and masks it again after a correction of the camera.

use crate::masked_robot::{HiddenPixels, MaskedRobot, Pinhole, Silhouette};
use crate::{DepthMap, Keyframe};
use std::sync::Arc;

/// The lenses with which a mask is drawn.
#[derive(Clone, Copy, Debug)]
pub struct MaskViews {
    /// Lens of the color image.
    pub color: Pinhole,
    /// Lens of the depth image, if there is one.
    pub depth: Option<Pinhole>,
}

impl MaskViews {
    /// The lenses of a keyframe.
    #[must_use]
    pub fn of(keyframe: &Keyframe) -> Self {
        Self {
            color: Pinhole {
                size_px: keyframe.size_px,
                focal_px: keyframe.focal_px,
                principal_px: keyframe.principal_px,
            },
            depth: keyframe.depth.as_ref().map(|depth| Pinhole {
                size_px: depth.size_px,
                focal_px: depth.focal_px,
                principal_px: depth.principal_px,
            }),
        }
    }
}

impl Keyframe {
    /// Masks a robot. Where it may be, the alpha of color and ground truth becomes 0, and depth has
    /// no readings. The mask of an earlier robot is removed. Returns the number of pixels of the
    /// color image that the robot covers. A keyframe without pixels is not changed.
    ///
    /// * `views`: lenses of the sizes of the images.
    pub fn mask_robot(&mut self, mut robot: MaskedRobot, views: &MaskViews) -> u64 {
        if self.check().is_err() {
            return 0;
        }
        let shown = self.robot.take();
        let before = shown.map_or_else(HiddenPixels::default, |robot| robot.hidden.clone());
        let silhouette = robot.in_color(views.color);
        let n_covered = covered(&silhouette, self.size_px)
            .filter(|is_covered| *is_covered)
            .count();
        let color = self.hidden_color(&before.color, &silhouette);
        if color != before.color {
            hide_color(&mut self.rgba_srgb, &before.color, &color);
            if let Some(truth) = &mut self.truth {
                hide_color(&mut truth.rgba_srgb, &before.color, &color);
            }
        }
        robot.hidden = HiddenPixels {
            color,
            ..HiddenPixels::default()
        };
        if let (Some(depth), Some(view)) = (&mut self.depth, views.depth) {
            let silhouette = robot.in_depth(view);
            hide_depth(depth, &before, &silhouette, &mut robot.hidden);
        }
        self.robot = Some(Arc::new(robot));
        n_covered as u64
    }

    /// Runs of the valid color pixels that a robot covers.
    ///
    /// * `hidden`: runs of valid pixels that are hidden now.
    fn hidden_color(&self, hidden: &[[u32; 2]], silhouette: &Silhouette) -> Vec<[u32; 2]> {
        let (rgba, _) = self.rgba_srgb.as_chunks::<4>();
        let mut is_valid: Vec<bool> = rgba.iter().map(|pixel| pixel[3] > 0).collect();
        for run in hidden {
            if let Some(pixels) = is_valid.get_mut(range(*run)) {
                pixels.fill(true);
            }
        }
        let both = is_valid.iter().zip(covered(silhouette, self.size_px));
        runs(both.map(|(is_valid, is_covered)| *is_valid && is_covered))
    }
}

/// Whether each pixel of an image is covered, row by row.
fn covered(
    silhouette: &Silhouette,
    [width, height]: [u32; 2],
) -> impl Iterator<Item = bool> + use<'_> {
    (0..height).flat_map(move |y| (0..width).map(move |x| silhouette.covers(x, y)))
}

/// Shows the pixels of the runs `shown`, and then hides the pixels of the runs `hidden`.
fn hide_color(rgba: &mut Arc<[u8]>, shown: &[[u32; 2]], hidden: &[[u32; 2]]) {
    let (rgba, _) = Arc::make_mut(rgba).as_chunks_mut::<4>();
    for (runs, alpha) in [(shown, 255), (hidden, 0)] {
        for run in runs {
            let pixels = rgba.get_mut(range(*run)).unwrap_or_default();
            pixels.iter_mut().for_each(|pixel| pixel[3] = alpha);
        }
    }
}

/// Restores the readings that were hidden, and hides the readings that a robot covers.
///
/// * `after`: receives the hidden readings.
fn hide_depth(
    depth: &mut DepthMap,
    before: &HiddenPixels,
    silhouette: &Silhouette,
    after: &mut HiddenPixels,
) {
    let mut readings = depth.depth_m.to_vec();
    let mut restored = before.depth_m.iter();
    for run in &before.depth {
        for reading in readings.get_mut(range(*run)).unwrap_or_default() {
            *reading = restored.next().copied().unwrap_or_default();
        }
    }
    let both = readings.iter().zip(covered(silhouette, depth.size_px));
    after.depth = runs(both.map(|(reading, is_covered)| *reading != 0.0 && is_covered));
    for run in &after.depth {
        for reading in &mut readings[range(*run)] {
            after.depth_m.push(std::mem::take(reading));
        }
    }
    // Keyframes with the same mask share their readings.
    if after.depth != before.depth {
        depth.depth_m = readings.into();
    }
}

/// The indices of a run.
fn range([first, n]: [u32; 2]) -> std::ops::Range<usize> {
    let first = first as usize;
    first..first.saturating_add(n as usize)
}

/// Runs of true values: index of the first value, and number of values.
fn runs(values: impl Iterator<Item = bool>) -> Vec<[u32; 2]> {
    let mut runs: Vec<[u32; 2]> = Vec::new();
    let mut continues = false;
    for (ix, value) in (0..).zip(values) {
        match runs.last_mut() {
            Some([_, n]) if value && continues => *n += 1,
            _ if value => runs.push([ix, 1]),
            _ => {}
        }
        continues = value;
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::masked_robot::{ConvexPiece, Sweep, Uncertainty};
    use crate::{Split, Truth};
    use kinematics::{Stamp, Transform};
    use nalgebra::{Point3, UnitQuaternion, Vector3};

    const SIZE_PX: [u32; 2] = [64, 48];

    /// A keyframe that sees everything, except for its first pixel and its first reading.
    fn keyframe() -> Keyframe {
        let reds = (0..=250_u8).cycle().take(64 * 48);
        let mut rgba: Vec<u8> = reds.flat_map(|red| [red, 7, 9, 255]).collect();
        rgba[3] = 0;
        let mut depth_m: Vec<f32> = (0..64_u16 * 48).map(|ix| 1.0 + f32::from(ix)).collect();
        depth_m[0] = 0.0;
        Keyframe {
            camera: "overview".into(),
            stamp: Stamp(1),
            size_px: SIZE_PX,
            focal_px: [60.0; 2],
            principal_px: [32.0, 24.0],
            rgba_srgb: rgba.clone().into(),
            depth: Some(DepthMap {
                size_px: SIZE_PX,
                focal_px: [60.0; 2],
                principal_px: [32.0, 24.0],
                depth_m: depth_m.into(),
                world_from_camera: Transform::translation(0.02, 0.0, 0.0),
            }),
            world_from_camera: Transform::identity(),
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::Train,
            truth: Some(Truth {
                rgba_srgb: rgba.into(),
                world_from_camera: Transform::identity(),
                psnr_ceiling: None,
            }),
            robot: None,
        }
    }

    /// A cube of 0.2 m that moves to the right, 1 m in front of the camera.
    fn robot() -> MaskedRobot {
        let cube: ConvexPiece = (0..8)
            .map(|corner| {
                let side = |bit: u32| if corner >> bit & 1 == 1 { 0.1 } else { -0.1 };
                Point3::new(side(0), side(1), side(2))
            })
            .collect();
        let sweep = Sweep {
            link_ix: 0,
            camera_from_link: [0.0, 0.1]
                .map(|x| Transform::translation(x, 0.0, 1.0))
                .into(),
        };
        MaskedRobot {
            links: Arc::new([vec![cube]]),
            uncertainty: Uncertainty {
                rotation_rad: 0.01,
                position_m: 0.01,
            },
            during_color: vec![sweep.clone()],
            during_depth: vec![sweep],
            camera_from_depth: Transform::translation(0.02, 0.0, 0.0),
            hidden: HiddenPixels::default(),
        }
    }

    fn masked(robot: MaskedRobot) -> Keyframe {
        let mut keyframe = keyframe();
        let views = MaskViews::of(&keyframe);
        assert!(keyframe.mask_robot(robot, &views) > 50);
        keyframe
    }

    fn alpha(keyframe: &Keyframe, [x, y]: [usize; 2]) -> u8 {
        keyframe.rgba_srgb[4 * (y * 64 + x) + 3]
    }

    fn readings(keyframe: &Keyframe) -> &Arc<[f32]> {
        &keyframe.depth.as_ref().expect("depth").depth_m
    }

    #[test]
    fn masks_hide_the_robot_only() {
        let original = keyframe();
        let masked = masked(robot());
        assert_eq!(alpha(&masked, [34, 24]), 0);
        assert_eq!(readings(&masked)[24 * 64 + 34], 0.0);
        assert_eq!(alpha(&masked, [5, 24]), 255);
        let truth = |keyframe: &Keyframe| keyframe.truth.clone().expect("truth").rgba_srgb;
        assert!(truth(&masked) == masked.rgba_srgb);
        let is_same_color = original
            .rgba_srgb
            .chunks(4)
            .zip(masked.rgba_srgb.chunks(4))
            .all(|(one, other)| one[..3] == other[..3]);
        assert!(is_same_color, "only alpha changes");
    }

    #[test]
    fn a_mask_that_is_drawn_again_equals_one_that_is_drawn_for_the_corrected_camera() {
        let turned = Transform::from_parts(
            Vector3::new(0.1, 0.05, -0.02).into(),
            UnitQuaternion::from_euler_angles(0.05, -0.2, 0.1),
        );
        let depth_correction = Transform::translation(0.03, 0.0, 0.0);
        let corrected = robot().seen_by_corrected(&turned, &depth_correction);
        let expected = masked(corrected);
        let mut again = masked(robot());
        let before = again.clone();
        let seen = again.robot.clone().expect("masked");
        let views = MaskViews::of(&again);
        again.mask_robot(seen.seen_by_corrected(&turned, &depth_correction), &views);
        assert!(before.rgba_srgb != again.rgba_srgb && readings(&before) != readings(&again));
        assert!(again.rgba_srgb == expected.rgba_srgb && readings(&again) == readings(&expected));
        let truth = |keyframe: &Keyframe| keyframe.truth.clone().expect("truth").rgba_srgb;
        assert!(truth(&again) == truth(&expected));
        assert_eq!(again.robot, expected.robot);
        assert_eq!(alpha(&again, [0, 0]), 0, "an invalid pixel stays invalid");
        // A robot that is out of view shows everything again.
        let away = Transform::translation(0.0, 0.0, -9.0);
        again.mask_robot(robot().seen_by_corrected(&away, &depth_correction), &views);
        let original = keyframe();
        assert!(again.rgba_srgb == original.rgba_srgb && readings(&again) == readings(&original));
    }

    #[test]
    fn keyframes_with_the_same_mask_share_their_pixels() {
        let mut again = masked(robot());
        let before = again.clone();
        let views = MaskViews::of(&again);
        again.mask_robot(robot(), &views);
        assert!(Arc::ptr_eq(&before.rgba_srgb, &again.rgba_srgb));
        assert!(Arc::ptr_eq(readings(&before), readings(&again)));
        // A keyframe without pixels is not changed.
        let mut empty = Keyframe {
            rgba_srgb: [].into(),
            ..before
        };
        assert_eq!(empty.mask_robot(robot(), &views), 0);
    }
}
