//! Disturbs keyframes, for example with pose noise or a clock offset of a given size.
//!
//! A clock offset and an exposure step affect all images, including test images, as they do on a
//! robot. Pose noise does not affect test images. They keep their true poses, so that the scores
//! measure the model.
//!
//! A disturbance is a pure function of its size, a seed and the keyframes. Its effect on a keyframe
//! does not depend on the order of the keyframes. All sizes with the same seed use the same random
//! directions. Random differences between sizes therefore do not add noise to a curve.

use crate::statistics::Interpolation;
use keyframe::{Keyframe, Split};
use kinematics::{Stamp, Transform, Twist, transform};
use nalgebra::{UnitQuaternion, Vector3};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Kinds of disturbances.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Disturbance {
    /// Errors of the camera poses.
    PoseNoise,
    /// The clock of the poses is offset from the clock of the images.
    ClockOffset,
    /// The exposure changes in the middle of the capture.
    Exposure,
    /// Fewer training keyframes.
    Keyframes,
}

/// Rotation noise per translation noise, degrees per millimeter. At 50 mm, the rotation noise is 5
/// degrees. Rotation and translation move a point at a distance of 0.57 m by the same length.
const DEGREES_PER_MM: f64 = 0.1;

impl Disturbance {
    /// All disturbances.
    pub const ALL: [Self; 4] = [
        Self::PoseNoise,
        Self::ClockOffset,
        Self::Exposure,
        Self::Keyframes,
    ];

    /// Name in files and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::PoseNoise => "pose-noise",
            Self::ClockOffset => "clock-offset",
            Self::Exposure => "exposure",
            Self::Keyframes => "keyframes",
        }
    }

    /// What is disturbed, and the range of the default sizes.
    #[must_use]
    pub fn description(self) -> &'static str {
        match self {
            Self::PoseNoise => "Errors of training poses: 0 to 50 mm and 0 to 5 degrees",
            Self::ClockOffset => "Poses from 0 to 200 ms after the image stamps",
            Self::Exposure => {
                "A sudden change of the exposure by 0 to 1 EV in the middle of the capture"
            }
            Self::Keyframes => "3 to 300 training keyframes",
        }
    }

    /// Axis label for the size, with its unit.
    pub(crate) fn axis(self) -> &'static str {
        match self {
            Self::PoseNoise => {
                "pose noise, mm (standard deviation along each axis; 0.1 degrees of rotation per mm)"
            }
            Self::ClockOffset => "clock offset of the poses, ms",
            Self::Exposure => "exposure step in the middle of the capture, EV",
            Self::Keyframes => "training keyframes",
        }
    }

    /// Unit of the size.
    pub(crate) fn unit(self) -> &'static str {
        match self {
            Self::PoseNoise => "mm",
            Self::ClockOffset => "ms",
            Self::Exposure => "EV",
            Self::Keyframes => "keyframes",
        }
    }

    /// Default sizes, in ascending order. For keyframes, the smallest number is the largest
    /// disturbance.
    pub(crate) fn default_levels(self) -> &'static [f64] {
        match self {
            Self::PoseNoise => &[0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0],
            Self::ClockOffset => &[0.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0],
            Self::Exposure => &[0.0, 0.1, 0.25, 0.5, 0.75, 1.0],
            Self::Keyframes => &[3.0, 5.0, 10.0, 20.0, 50.0, 100.0, 300.0],
        }
    }

    /// The interpolation of a break point between two sizes, see
    /// [`break_point`](crate::statistics::break_point).
    pub(crate) fn interpolation(self) -> Interpolation {
        match self {
            Self::Keyframes => Interpolation::Log,
            Self::PoseNoise | Self::ClockOffset | Self::Exposure => Interpolation::Linear,
        }
    }

    /// Applies the disturbance to keyframes.
    ///
    /// * `level`: size in [`Self::unit`].
    /// * `nanos_per_sec`: length of a second in units of the stamps. It is 1e9, except for stamps
    ///   that only count images.
    pub(crate) fn apply(
        self,
        keyframes: &[Arc<Keyframe>],
        level: f64,
        seed: u64,
        nanos_per_sec: f64,
    ) -> Vec<Arc<Keyframe>> {
        match self {
            Self::PoseNoise => pose_noise(keyframes, level, seed),
            Self::ClockOffset => clock_offset(keyframes, level * 1e-3 * nanos_per_sec),
            Self::Exposure => exposure_step(keyframes, level),
            Self::Keyframes => subsample(keyframes, level),
        }
    }
}

/// Copies of keyframes with a change applied.
fn map(keyframes: &[Arc<Keyframe>], mut change: impl FnMut(&mut Keyframe)) -> Vec<Arc<Keyframe>> {
    let mut changed_keyframes = Vec::new();
    for keyframe in keyframes {
        let mut changed = keyframe.as_ref().clone();
        change(&mut changed);
        changed_keyframes.push(Arc::new(changed));
    }
    changed_keyframes
}

/// Moves a camera together with its depth sensor.
fn move_to(keyframe: &mut Keyframe, world_from_camera: Transform) {
    let moved_from_original = world_from_camera * keyframe.world_from_camera.inverse();
    if let Some(depth) = &mut keyframe.depth {
        depth.world_from_camera = moved_from_original * depth.world_from_camera;
    }
    keyframe.world_from_camera = world_from_camera;
}

fn pose_noise(keyframes: &[Arc<Keyframe>], sigma_mm: f64, seed: u64) -> Vec<Arc<Keyframe>> {
    let sigma_m = 1e-3 * sigma_mm;
    let sigma_rad = (DEGREES_PER_MM * sigma_mm).to_radians();
    map(keyframes, |keyframe| {
        if keyframe.split == Split::Test {
            return;
        }
        let [x, y, z, rotation_x, rotation_y, rotation_z] =
            six_normals(seed, &keyframe.camera, keyframe.stamp);
        let camera_from_disturbed = Transform::from_parts(
            (Vector3::new(x, y, z) * sigma_m).into(),
            UnitQuaternion::from_scaled_axis(
                Vector3::new(rotation_x, rotation_y, rotation_z) * sigma_rad,
            ),
        );
        move_to(keyframe, keyframe.world_from_camera * camera_from_disturbed);
    })
}

/// Six independent samples of a standard normal distribution, determined by seed, camera and stamp.
///
/// Source: Box and Muller 1958, applied to uniform numbers from a hash.
fn six_normals(seed: u64, camera: &str, stamp: Stamp) -> [f64; 6] {
    let mut normals = [0.0; 6];
    // A hash has no state, so the noise of a keyframe does not depend on the other keyframes.
    for (ix, pair) in (0_u8..).zip(normals.chunks_exact_mut(2)) {
        let mut hash = Sha256::new();
        hash.update(seed.to_le_bytes());
        hash.update(stamp.0.to_le_bytes());
        hash.update([ix]);
        hash.update(camera.as_bytes());
        let bytes = hash.finalize();
        // Two uniform numbers give two independent normal numbers.
        let radius = (-2.0 * uniform(&bytes[..8]).ln()).sqrt();
        let (sine, cosine) = (std::f64::consts::TAU * uniform(&bytes[8..16])).sin_cos();
        pair.copy_from_slice(&[radius * cosine, radius * sine]);
    }
    normals
}

/// A number between 0 and 1, both exclusive, from eight bytes.
fn uniform(bytes: &[u8]) -> f64 {
    // 53 bits fill the fraction of an f64. The offset of 0.5 keeps the logarithm finite.
    let bits = u64::from_le_bytes(bytes.try_into().expect("eight bytes")) >> 11;
    (bits as f64 + 0.5) / (1_u64 << 53) as f64
}

/// Poses and velocities of one camera over time, from its keyframes.
type Trajectory = Vec<(Stamp, Transform, Option<Twist>)>;

/// Gives each keyframe the pose and velocity of its camera `offset_nanos` later.
fn clock_offset(keyframes: &[Arc<Keyframe>], offset_nanos: f64) -> Vec<Arc<Keyframe>> {
    let mut trajectories: BTreeMap<Arc<str>, Trajectory> = BTreeMap::new();
    for keyframe in keyframes {
        let state = (keyframe.stamp, keyframe.world_from_camera, keyframe.twist);
        trajectories
            .entry(keyframe.camera.clone())
            .or_default()
            .push(state);
    }
    // Keyframes may be in the order of their files. Two keyframes with the same stamp would give an
    // interval of length 0.
    for trajectory in trajectories.values_mut() {
        trajectory.sort_by_key(|(stamp, ..)| *stamp);
        trajectory.dedup_by_key(|(stamp, ..)| *stamp);
    }
    map(keyframes, |keyframe| {
        let nanos = keyframe.stamp.0 as f64 + offset_nanos;
        if let Some((pose, twist)) = at(&trajectories[&keyframe.camera], nanos) {
            move_to(keyframe, pose);
            keyframe.twist = twist.or(keyframe.twist);
        }
    })
}

/// Pose and velocity at a time, interpolated between the neighboring states or extrapolated beyond
/// the ends.
fn at(trajectory: &Trajectory, nanos: f64) -> Option<(Transform, Option<Twist>)> {
    // Times outside the trajectory use its first or last interval, with `frac` below 0 or above 1.
    // A single keyframe defines no interval.
    let next = trajectory.partition_point(|(stamp, ..)| (stamp.0 as f64) < nanos);
    let next = next.clamp(1, trajectory.len().checked_sub(1).filter(|last| *last > 0)?);
    let [(stamp_a, a, twist_a), (stamp_b, b, twist_b)] = [&trajectory[next - 1], &trajectory[next]];
    let frac = (nanos - stamp_a.0 as f64) / stamp_b.nanos_since(*stamp_a) as f64;
    let twist = twist_a.zip(*twist_b).map(|(a, b)| Twist {
        linear_m_s: a.linear_m_s.lerp(&b.linear_m_s, frac),
        angular_rad_s: a.angular_rad_s.lerp(&b.angular_rad_s, frac),
    });
    Some((transform::interpolate(a, b, frac), twist))
}

/// Darkens the first half of the capture and brightens the second, by half of `step_ev` each to
/// preserve the mean.
fn exposure_step(keyframes: &[Arc<Keyframe>], step_ev: f64) -> Vec<Arc<Keyframe>> {
    // The exposure changes at the median stamp of the training images, so that both exposures have
    // the same number of training images.
    let mut stamps: Vec<Stamp> = keyframes
        .iter()
        .filter(|keyframe| keyframe.split != Split::Test)
        .map(|keyframe| keyframe.stamp)
        .collect();
    stamps.sort();
    let Some(middle) = stamps.get(stamps.len() / 2).copied() else {
        return keyframes.to_vec();
    };
    let [darker, brighter] =
        [-0.5, 0.5].map(|fraction| exposure_table(2.0_f64.powf(fraction * step_ev)));
    map(keyframes, |keyframe| {
        expose(
            keyframe,
            if keyframe.stamp < middle {
                &darker
            } else {
                &brighter
            },
        );
    })
}

/// Replaces each color value of an image by its value in the table.
pub(crate) fn expose(keyframe: &mut Keyframe, table: &[u8; 256]) {
    let pixels = keyframe.rgba_srgb.chunks_exact(4);
    keyframe.rgba_srgb = pixels
        .flat_map(|rgba| {
            [
                table[rgba[0] as usize],
                table[rgba[1] as usize],
                table[rgba[2] as usize],
                rgba[3],
            ]
        })
        .collect();
}

/// Maps each sRGB byte to the byte for `gain` times its linear light. The result is clipped and
/// rounded to 8 bits.
///
/// Source: IEC 61966-2-1 for both transfer functions.
pub(crate) fn exposure_table(gain: f64) -> [u8; 256] {
    std::array::from_fn(|byte| {
        let srgb = byte as f64 / 255.0;
        let linear = if srgb <= 0.04045 {
            srgb / 12.92
        } else {
            ((srgb + 0.055) / 1.055).powf(2.4)
        };
        let linear = (gain * linear).clamp(0.0, 1.0);
        let srgb = if linear <= 0.0031308 {
            12.92 * linear
        } else {
            1.055 * linear.powf(1.0 / 2.4) - 0.055
        };
        #[expect(clippy::cast_possible_truncation, reason = "clamped to 0 to 1 above")]
        let byte = (255.0 * srgb).round() as u8;
        byte
    })
}

/// Keeps `n` evenly spaced training keyframes and all test keyframes.
fn subsample(keyframes: &[Arc<Keyframe>], n: f64) -> Vec<Arc<Keyframe>> {
    let n_all = keyframes
        .iter()
        .filter(|keyframe| keyframe.split != Split::Test)
        .count() as f64;
    let fraction = (n / n_all).min(1.0);
    let mut n_visited = 0.0_f64;
    let mut kept = Vec::new();
    for keyframe in keyframes {
        if keyframe.split == Split::Test {
            kept.push(keyframe.clone());
            continue;
        }
        // This keeps the keyframe in the middle of each of n equal segments.
        let before = (n_visited * fraction + 0.5).floor();
        n_visited += 1.0;
        if (n_visited * fraction + 0.5).floor() > before {
            kept.push(keyframe.clone());
        }
    }
    kept
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    const TOLERANCE: f64 = 1e-9; // Rounding errors of products of poses with elements near 1.

    /// A camera that moves along a line and rotates, by 0.1 m and 0.02 rad per keyframe. There are
    /// 10 keyframes per second, with gray images.
    pub(crate) fn capture(n: i64) -> Vec<Arc<Keyframe>> {
        let keyframe = |ix: i64| {
            let along = ix as f64;
            Arc::new(Keyframe {
                camera: "wrist".into(),
                stamp: Stamp(ix * 100_000_000),
                size_px: [2, 1],
                focal_px: [1.0; 2],
                principal_px: [1.0, 0.5],
                rgba_srgb: [0, 128, 250, 255, 10, 20, 30, 0].into(),
                depth: Some(keyframe::DepthMap {
                    size_px: [1, 1],
                    focal_px: [1.0; 2],
                    principal_px: [0.5; 2],
                    depth_m: [1.0].into(),
                    world_from_camera: Transform::new(
                        Vector3::new(0.1 * along + 0.02, 0.0, 0.0),
                        Vector3::new(0.0, 0.0, 0.02 * along),
                    ),
                }),
                world_from_camera: Transform::new(
                    Vector3::new(0.1 * along, 0.0, 0.0),
                    Vector3::new(0.0, 0.0, 0.02 * along),
                ),
                twist: None,
                readout_secs: 0.0,
                joint_twists: [].into(),
                base: None,
                split: Split::of(usize::try_from(ix).expect("not negative")),
                truth: None,
                robot: None,
            })
        };
        (0..n).map(keyframe).collect()
    }

    fn trained(keyframes: &[Arc<Keyframe>]) -> impl Iterator<Item = &Arc<Keyframe>> {
        keyframes
            .iter()
            .filter(|keyframe| keyframe.split != Split::Test)
    }

    #[test]
    fn pose_noise_spares_test_keyframes_and_zero_is_identity() {
        let capture = capture(40);
        for disturbance in Disturbance::ALL {
            let changed = disturbance.apply(&capture, 3.0, 1, 1e9);
            let tests = |keyframes: &[Arc<Keyframe>]| -> Vec<Arc<Keyframe>> {
                keyframes
                    .iter()
                    .filter(|keyframe| keyframe.split == Split::Test)
                    .cloned()
                    .collect()
            };
            let is_unchanged =
                matches!(disturbance, Disturbance::PoseNoise | Disturbance::Keyframes);
            for (before, after) in tests(&capture).iter().zip(tests(&changed)) {
                let is_same = before.world_from_camera == after.world_from_camera
                    && before.rgba_srgb == after.rgba_srgb;
                assert_eq!(is_same, is_unchanged, "{disturbance:?} and a test keyframe");
            }
            assert_eq!(tests(&changed).len(), 5, "{disturbance:?}");
        }
        for disturbance in [
            Disturbance::PoseNoise,
            Disturbance::ClockOffset,
            Disturbance::Exposure,
        ] {
            for (before, after) in capture.iter().zip(disturbance.apply(&capture, 0.0, 1, 1e9)) {
                let difference = before.world_from_camera.inverse() * after.world_from_camera;
                assert!(
                    difference.translation.vector.norm() + difference.rotation.angle() < TOLERANCE,
                    "{disturbance:?} of size 0 moves"
                );
                assert_eq!(before.rgba_srgb, after.rgba_srgb, "{disturbance:?}");
            }
        }
    }

    #[test]
    fn pose_noise_has_the_requested_std() {
        /// The tolerance is four standard errors of the standard deviation over three axes of 3500
        /// keyframes.
        const REL_TOLERANCE: f64 = 0.03;
        let capture = capture(4000);
        let noisy = pose_noise(&capture, 20.0, 7);
        let (mut translations, mut rotations) = (Vec::new(), Vec::new());
        for (before, after) in trained(&capture).zip(trained(&noisy)) {
            let difference = before.world_from_camera.inverse() * after.world_from_camera;
            translations.extend(difference.translation.vector.iter().copied());
            rotations.extend(difference.rotation.scaled_axis().iter().copied());
            let [depth_before, depth_after] = [before, after]
                .map(|keyframe| keyframe.depth.as_ref().expect("depth").world_from_camera);
            let camera_from_depth =
                |camera: &Transform, depth: &Transform| camera.inverse() * depth;
            let moved = camera_from_depth(&before.world_from_camera, &depth_before).inverse()
                * camera_from_depth(&after.world_from_camera, &depth_after);
            assert!(
                moved.translation.vector.norm() + moved.rotation.angle() < TOLERANCE,
                "depth moves with its camera"
            );
        }
        for (values, sigma) in [(translations, 0.02), (rotations, 2.0_f64.to_radians())] {
            let n = values.len() as f64;
            let mean = values.iter().sum::<f64>() / n;
            let std = (values.iter().map(|value| value * value).sum::<f64>() / n).sqrt();
            assert!(mean.abs() < 4.0 * sigma / n.sqrt(), "mean {mean}");
            assert!(
                (std / sigma - 1.0).abs() < REL_TOLERANCE,
                "standard deviation {std}, not {sigma}"
            );
        }
    }

    #[test]
    fn pose_noise_is_deterministic_linear_and_seeded() {
        let capture = capture(10);
        let translation_of = |sigma_mm: f64, seed: u64| {
            let noisy = pose_noise(&capture, sigma_mm, seed);
            (capture[1].world_from_camera.inverse() * noisy[1].world_from_camera)
                .translation
                .vector
        };
        assert_eq!(translation_of(5.0, 1), translation_of(5.0, 1));
        assert!((translation_of(10.0, 1) - 2.0 * translation_of(5.0, 1)).norm() < TOLERANCE);
        assert!((translation_of(5.0, 2) - translation_of(5.0, 1)).norm() > 1e-4);
        let alone = pose_noise(&capture[1..2], 5.0, 1);
        assert_eq!(
            alone[0].world_from_camera,
            pose_noise(&capture, 5.0, 1)[1].world_from_camera
        );
    }

    #[test]
    fn clock_offset_uses_poses_of_a_later_time() {
        let capture = capture(20);
        // 50 ms is half the time to the next keyframe. With 250 ms, the last keyframes are
        // extrapolated.
        for (millis, n_keyframes) in [(50.0, 0.5), (200.0, 2.0), (250.0, 2.5), (-50.0, -0.5)] {
            let moved = Disturbance::ClockOffset.apply(&capture, millis, 1, 1e9);
            for (before, after) in trained(&capture).zip(trained(&moved)) {
                let expected_x = before.world_from_camera.translation.x + 0.1 * n_keyframes;
                let expected_angle_rad =
                    before.world_from_camera.rotation.angle() + 0.02 * n_keyframes;
                assert!(
                    (after.world_from_camera.translation.x - expected_x).abs() < TOLERANCE,
                    "{millis} ms"
                );
                assert!(
                    (after.world_from_camera.rotation.angle() - expected_angle_rad).abs()
                        < TOLERANCE,
                    "{millis} ms"
                );
            }
        }
        // If stamps count images, the image rate defines the length of a second. At 1 image per
        // second, 100 ms is 0.1 images.
        let counted = Disturbance::ClockOffset.apply(&capture, 100.0, 1, 1e8);
        assert!((counted[1].world_from_camera.translation.x - 0.11).abs() < TOLERANCE);
        let alone = clock_offset(&capture[1..2], 1e8);
        assert_eq!(
            alone[0].world_from_camera, capture[1].world_from_camera,
            "a single keyframe defines no motion"
        );
    }

    #[test]
    fn exposure_is_multiplied_in_linear_light() {
        assert!(
            exposure_table(1.0)
                .iter()
                .enumerate()
                .all(|(byte, after)| byte == *after as usize)
        );
        let doubled = exposure_table(2.0);
        // The byte 128 is 0.2159 in linear light, and twice this light is the byte 175.6. The byte
        // 188 is just above 0.5 in linear light.
        assert_eq!(
            (doubled[0], doubled[128], doubled[188], doubled[255]),
            (0, 176, 255, 255)
        );
        let capture = capture(20);
        let stepped = exposure_step(&capture, 2.0);
        assert_eq!(stepped[1].rgba_srgb[1], exposure_table(0.5)[128]);
        assert_eq!(stepped[19].rgba_srgb[1], 176);
        assert_eq!(
            &stepped[19].rgba_srgb[3..5],
            &[255, exposure_table(2.0)[10]],
            "alpha is unchanged"
        );
        assert_eq!(stepped[19].rgba_srgb[7], 0, "alpha is unchanged");
    }

    #[test]
    fn subsampled_keyframes_are_spread_evenly() {
        let capture = capture(80);
        for n in [1, 3, 10, 69, 70] {
            let kept = subsample(&capture, f64::from(n));
            let ixs: Vec<i64> = trained(&kept)
                .map(|keyframe| keyframe.stamp.0 / 100_000_000)
                .collect();
            assert_eq!(ixs.len(), n as usize);
            let (first, last) = (ixs[0], ixs[ixs.len() - 1]);
            assert!(
                first <= 80 / i64::from(n) && last >= 79 - 80 / i64::from(n),
                "{ixs:?}"
            );
        }
        assert_eq!(trained(&subsample(&capture, 300.0)).count(), 70);
    }
}
