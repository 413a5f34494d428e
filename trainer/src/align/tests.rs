//! A room of textured planes seen by a camera on an arm of four joints, with one thing wrong at a time.

use super::*;
use crate::splat::CameraFix;
use crate::{DepthMap, Keyframe};
use kinematics::{Stamp, Transform, Twist, transform};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

const SIZE_PX: [u32; 2] = [160, 120];
const FOCAL_PX: [f64; 2] = [150.0, 148.0];
const PRINCIPAL_PX: [f64; 2] = [81.0, 59.0];
const N_IMAGES: usize = 40;
const READOUT_SECS: f64 = 0.02;

pub(crate) type Joints = [f64; 4];

/// Azimuth, elevation, roll (radians) and reach (metres).
fn base_from_flange([azimuth, elevation, roll, reach]: Joints) -> Transform {
    let turn = |axis: Vector3<f64>, angle: f64| {
        Isometry3::from_parts(Translation3::identity(), UnitQuaternion::from_scaled_axis(axis * angle))
    };
    let shift = |x: f64, y: f64, z: f64| Isometry3::translation(x, y, z);
    // At zero the flange looks along x, with x to the right: -y of the base.
    let looking =
        UnitQuaternion::from_matrix(&nalgebra::Matrix3::from_columns(&[-Vector3::y(), -Vector3::z(), Vector3::x()]));
    turn(Vector3::z(), azimuth)
        * shift(0.1, 0.0, 0.5)
        * turn(Vector3::y(), elevation)
        * shift(reach, 0.05, 0.0)
        * turn(Vector3::x(), roll)
        * Isometry3::from_parts(Translation3::identity(), looking)
}

fn flange_from_camera() -> Transform {
    Transform::new(Vector3::new(0.03, -0.02, 0.05), Vector3::new(0.05, -0.1, 0.3))
}

fn camera_at(joints: Joints) -> Transform {
    base_from_flange(joints) * flange_from_camera()
}

/// A scan in all joints, or about the azimuth alone; seconds.
fn joints_at(secs: f64, azimuth_only: bool) -> Joints {
    let wave = |size: f64, hz: f64, phase: f64| size * (2.0 * std::f64::consts::PI * hz * secs + phase).sin();
    match azimuth_only {
        true => [wave(0.5, 0.11, 0.2), 0.15, 0.2, 0.1],
        false => [wave(0.4, 0.11, 0.2), 0.15 + wave(0.25, 0.23, 1.0), wave(0.5, 0.17, 2.0), 0.1 + wave(0.1, 0.31, 0.5)],
    }
}

/// How the camera moves with a change of the joints along a direction.
fn twist_along(joints: Joints, direction: Joints) -> Twist {
    const STEP: f64 = 1e-5;
    let at = |sign: f64| camera_at(std::array::from_fn(|ix| joints[ix] + sign * STEP * direction[ix]));
    transform::log(&(at(-1.0).inverse() * at(1.0)), 2.0 * STEP)
}

/// Distance along the ray to the nearest plane, and the brightness there.
fn cast(from: Point3<f64>, ray: Vector3<f64>) -> (f64, f64) {
    let planes = [
        (Vector3::x(), 1.2),
        (Vector3::new(-0.4, 1.0, 0.1).normalize(), 0.8),
        (Vector3::new(-0.3, -1.0, 0.0).normalize(), 0.7),
        (-Vector3::z(), 0.1),
        (Vector3::new(0.8, 0.2, -1.0).normalize(), 0.75),
        (Vector3::z(), 1.4),
    ];
    let distance = |(normal, offset): &(Vector3<f64>, f64)| {
        let along = normal.dot(&ray);
        let distance = (offset - normal.dot(&from.coords)) / along;
        if along > 0.0 && distance > 0.0 { distance } else { f64::INFINITY }
    };
    let nearest = planes.iter().map(distance).fold(f64::INFINITY, f64::min);
    let p = from + ray * nearest;
    let wave = |size: f64, x: f64, y: f64, z: f64, phase: f64| size * (x * p.x + y * p.y + z * p.z + phase).sin();
    let brightness = 128.0
        + wave(30.0, 21.0, 13.0, -17.0, 0.3)
        + wave(25.0, -11.0, 29.0, 9.0, 1.3)
        + wave(25.0, 8.0, -7.0, 31.0, 2.1)
        + wave(20.0, 3.0, 5.0, 4.0, 0.0)
        + wave(12.0, 43.0, -31.0, 37.0, 0.7);
    (nearest, brightness.clamp(0.0, 255.0))
}

/// What is wrong, and how noisy images are.
#[derive(Clone)]
pub(crate) struct Wrong {
    /// The input has the camera at the true pose times this.
    pub(crate) mount: Transform,
    pub(crate) delay_secs: f64,
    pub(crate) joints: Joints,
    /// The input has the depth frame at the true pose times this.
    pub(crate) depth_pose: Transform,
    pub(crate) focal_frac: f64,
    pub(crate) depth_frac: f64,
    pub(crate) readout_secs: f64,
    pub(crate) azimuth_only: bool,
    pub(crate) rolls: bool,
    pub(crate) noise: f64,
    pub(crate) seed: u64,
}

impl Wrong {
    pub(crate) fn nothing() -> Self {
        Self {
            mount: Transform::identity(),
            delay_secs: 0.0,
            joints: [0.0; 4],
            depth_pose: Transform::identity(),
            focal_frac: 0.0,
            depth_frac: 0.0,
            readout_secs: 0.0,
            azimuth_only: false,
            rolls: false,
            noise: 1.0,
            seed: 1,
        }
    }
}

/// Normal noise by hashing.
fn noise(key: u64) -> f64 {
    let mut state = key.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0xd1b5_4a32_d192_ed03;
    let mut uniform = || {
        state ^= state >> 29;
        state = state.wrapping_mul(0xbf58_476d_1ce4_e5b9);
        state ^= state >> 32;
        ((state >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    };
    let (one, two) = (uniform(), uniform());
    (-2.0 * one.ln()).sqrt() * (2.0 * std::f64::consts::PI * two).cos()
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "bytes and stamps of a test")]
pub(crate) fn capture(wrong: &Wrong) -> Vec<Arc<Keyframe>> {
    let image = |ix: usize| {
        let secs = 0.3 * ix as f64 + 0.05 * (ix as f64 * 1.7).sin();
        let joints = |secs: f64| joints_at(secs, wrong.azimuth_only);
        let [width, height] = SIZE_PX.map(|side| side as usize);
        let looked = |pose: &Transform, x: usize, y: usize| {
            let at = [x as f64 + 0.5, y as f64 + 0.5];
            let ray =
                Vector3::new((at[0] - PRINCIPAL_PX[0]) / FOCAL_PX[0], (at[1] - PRINCIPAL_PX[1]) / FOCAL_PX[1], 1.0);
            cast(Point3::from(pose.translation.vector), pose.rotation * ray)
        };
        let key =
            |pixel: usize, stream: u64| wrong.seed * 1_000_003 + (ix as u64 * 100_000 + pixel as u64) * 2 + stream;
        let mut rgba = Vec::new();
        for y in 0..height {
            let share = (y as f64 + 0.5) / height as f64 - 0.5;
            let pose = camera_at(joints(secs + if wrong.rolls { share * READOUT_SECS } else { 0.0 }));
            for x in 0..width {
                let (_, value) = looked(&pose, x, y);
                let value = (value + wrong.noise * noise(key(y * width + x, 0))).round().clamp(0.0, 255.0) as u8;
                rgba.extend([value, value, value, 255]);
            }
        }
        let depth_from_true = Transform::new(Vector3::new(0.02, 0.0, 0.0), Vector3::zeros());
        let depth_pose = camera_at(joints(secs)) * depth_from_true;
        let depth_m: Vec<f32> = (0..width * height)
            .map(|pixel| {
                let z = looked(&depth_pose, pixel % width, pixel / width).0;
                ((z + 0.0007 * wrong.noise * z * z * noise(key(pixel, 1))) * (1.0 - wrong.depth_frac)) as f32
            })
            .collect();
        let claimed_joints = {
            let moved = joints(secs - wrong.delay_secs);
            std::array::from_fn(|joint| moved[joint] - wrong.joints[joint])
        };
        let claimed = camera_at(claimed_joints) * wrong.mount;
        let attached = |twist: Twist| twist.of_attached(&wrong.mount);
        let rates = {
            let (before, after) = (joints(secs - wrong.delay_secs - 1e-4), joints(secs - wrong.delay_secs + 1e-4));
            std::array::from_fn(|joint| (after[joint] - before[joint]) / 2e-4)
        };
        let unit = |joint: usize| std::array::from_fn(|other| if joint == other { 1.0 } else { 0.0 });
        Arc::new(Keyframe {
            camera: "wrist".into(),
            stamp: Stamp((secs * 1e9) as i64),
            size_px: SIZE_PX,
            focal_px: FOCAL_PX.map(|focal| focal * (1.0 + wrong.focal_frac)),
            principal_px: PRINCIPAL_PX,
            rgba_srgb: rgba.into(),
            depth: Some(DepthMap {
                size_px: SIZE_PX,
                focal_px: FOCAL_PX,
                principal_px: PRINCIPAL_PX,
                depth_m: depth_m.into(),
                world_from_camera: claimed * depth_from_true * wrong.depth_pose,
            }),
            world_from_camera: claimed,
            twist: Some(attached(twist_along(claimed_joints, rates))),
            readout_secs: if wrong.rolls { READOUT_SECS - wrong.readout_secs } else { 0.0 },
            joint_twists: (0..4).map(|joint| attached(twist_along(claimed_joints, unit(joint)))).collect(),
            base: None,
            split: Split::of(ix),
            truth: None,
        })
    };
    (0..N_IMAGES).into_par_iter().map(image).collect()
}

fn given(wrong: &Wrong, change: fn(&mut TermSet)) -> Alignment {
    let mut set = TermSet::default();
    change(&mut set);
    align(&capture(wrong), &CameraChoice::Given(set)).unwrap()
}

fn tried(wrong: &Wrong) -> Alignment {
    align(&capture(wrong), &CameraChoice::Try(candidates())).unwrap()
}

pub(crate) fn wrong_mount() -> Transform {
    Transform::new(Vector3::new(0.003, -0.0035, 0.002), Vector3::new(0.01, 0.012, -0.008))
}

/// Turn and way of what is left of a mount, degrees and millimetres.
pub(crate) fn left(fix: &CameraFix, wrong: &Transform) -> (f64, f64) {
    let found = crate::splat::moved(fix.turn_rad.into(), fix.shift_m.into());
    let left = wrong * found.inverse();
    (left.rotation.angle().to_degrees(), 1e3 * left.translation.vector.norm())
}

#[test]
fn a_wrong_mount_is_found() {
    let wrong = Wrong { mount: wrong_mount(), ..Wrong::nothing() };
    let alignment = given(&wrong, |set| set.mount = true);
    let (degrees, mm) = left(&alignment.fixes["wrist"], &wrong.mount);
    assert!(degrees < 0.05 && mm < 0.5, "{degrees} degrees, {mm} mm");
}

#[test]
fn a_wrong_delay_is_found() {
    let alignment = given(&Wrong { delay_secs: 0.02, ..Wrong::nothing() }, |set| set.delay = true);
    assert!((alignment.fixes["wrist"].delay_secs - 0.02).abs() < 5e-4);
}

#[test]
fn wrong_joints_are_found() {
    let wrong = Wrong { joints: [0.0, 0.009, -0.007, 0.002], ..Wrong::nothing() };
    let alignment = given(&wrong, |set| set.joints = true);
    let offsets = &alignment.fixes["wrist"].joint_offsets;
    for joint in 1..4 {
        assert!((offsets[joint] - wrong.joints[joint]).abs() < 5e-4, "{offsets:?}");
    }
    // The first joint turns the whole world.
    assert!(offsets[0].abs() < 1e-4 && alignment.unseen.len() == 1, "{offsets:?} {:?}", alignment.unseen);
    assert_eq!(alignment.unseen[0].parts, ["offset of joint 0"]);
}

#[test]
fn a_wrong_depth_pose_is_found() {
    let off = Transform::new(Vector3::new(0.004, -0.003, 0.002), Vector3::new(-0.006, 0.008, 0.005));
    let alignment = given(&Wrong { depth_pose: off, ..Wrong::nothing() }, |set| set.depth_pose = true);
    let fix = &alignment.fixes["wrist"];
    // The input has true * off; the fix stands on the left of color_from_depth.
    let base = Transform::new(Vector3::new(0.02, 0.0, 0.0), Vector3::zeros());
    let found = crate::splat::moved(fix.depth_turn_rad.into(), fix.depth_shift_m.into()) * base * off;
    let left = base.inverse() * found;
    assert!(left.rotation.angle().to_degrees() < 0.06 && left.translation.vector.norm() < 1e-3, "{left:?}");
}

#[test]
fn a_wrong_lens_is_found() {
    let alignment = given(&Wrong { focal_frac: 0.01, ..Wrong::nothing() }, |set| set.lens = true);
    let fix = &alignment.fixes["wrist"];
    assert!(fix.log_focal.iter().all(|log| (log.exp() * 1.01 - 1.0).abs() < 1.5e-3), "{fix:?}");
    assert!(fix.principal_focals.iter().all(|shift| shift.abs() < 1.5e-3), "{fix:?}");
}

#[test]
fn a_wrong_scale_of_depth_is_found() {
    let alignment = given(&Wrong { depth_frac: 0.01, ..Wrong::nothing() }, |set| set.depth_scale = true);
    assert!((alignment.fixes["wrist"].log_depth_scale.exp() * 0.99 - 1.0).abs() < 1e-3);
}

#[test]
fn a_wrong_readout_is_found() {
    let wrong = Wrong { rolls: true, readout_secs: 0.012, ..Wrong::nothing() };
    let alignment = given(&wrong, |set| set.readout = true);
    assert!((alignment.fixes["wrist"].readout_secs - 0.012).abs() < 1.5e-3);
}

#[test]
fn what_a_motion_does_not_show_of_a_mount_is_told_where_the_mount_is_right_too() {
    let alignment = tried(&Wrong { azimuth_only: true, ..Wrong::nothing() });
    assert!(!alignment.is_any(), "{alignment:?}");
    let parts: Vec<_> = alignment.unseen.iter().flat_map(|unseen| &unseen.parts).collect();
    assert!(parts.iter().any(|part| part.starts_with("translation of camera \"wrist\" along")), "{parts:?}");
    assert!(tried(&Wrong::nothing()).unseen.is_empty(), "a full motion shows all");
}

#[test]
fn a_turn_about_one_axis_does_not_show_all_of_a_mount() {
    let wrong = Wrong { mount: wrong_mount(), azimuth_only: true, ..Wrong::nothing() };
    let alignment = given(&wrong, |set| set.mount = true);
    assert_eq!(alignment.unseen.len(), 2, "{:?}", alignment.unseen);
    assert_eq!(alignment.unseen[0].parts.len(), 1);
    assert!(alignment.unseen[0].parts[0].starts_with("translation of camera \"wrist\" along"));
    // Up in the base, in the camera's axes; nothing was found along it.
    let up = (camera_at(joints_at(0.0, true)) * wrong.mount).rotation.inverse() * Vector3::z();
    let shift: Vector3<f64> = alignment.fixes["wrist"].shift_m.into();
    assert!(shift.dot(&up).abs() < 1e-4, "{shift:?} along {up:?}");
}

#[test]
fn nothing_is_kept_where_nothing_is_wrong() {
    for rolls in [false, true] {
        let alignment = tried(&Wrong { rolls, ..Wrong::nothing() });
        assert!(!alignment.is_any(), "{:?}", alignment.found);
        assert_eq!(alignment.trials.len(), if rolls { 8 } else { 7 });
    }
}

#[test]
fn only_the_cause_is_kept() {
    let kept = |wrong: &Wrong| -> Vec<String> {
        tried(wrong).trials.iter().filter(|trial| trial.kept).map(|trial| trial.candidate.to_string()).collect()
    };
    assert_eq!(kept(&Wrong { mount: wrong_mount(), ..Wrong::nothing() }), ["camera mounts"]);
    assert_eq!(kept(&Wrong { delay_secs: 0.02, ..Wrong::nothing() }), ["delays"]);
}

#[test]
fn deviations_are_as_large_as_errors() {
    const SEEDS: u64 = 6;
    let mut squares = Vec::new();
    for seed in 0..SEEDS {
        let wrong = Wrong { mount: wrong_mount(), seed, noise: 3.0, ..Wrong::nothing() };
        let scene = Scene::new(&capture(&wrong), false).unwrap();
        let layout = Layout::new(TermSet { mount: true, ..TermSet::default() }, &scene.frames, 1);
        let fit = fit::fit(&scene.frames, &scene.pairs, layout, &Corrections::none(1)).unwrap();
        let fix = &fit.corrections.fixes[0];
        let left = transform::log(
            &(wrong.mount * crate::splat::moved(fix.turn_rad.into(), fix.shift_m.into()).inverse()),
            1.0,
        );
        let errors = left.linear_m_s.iter().chain(left.angular_rad_s.iter());
        squares.extend(errors.enumerate().map(|(ix, error)| (error / fit.solved.sigma(ix)).powi(2)));
    }
    let mean = squares.iter().sum::<f64>() / squares.len() as f64;
    assert!((0.25..4.0).contains(&mean), "{mean} of {squares:.1?}");
}

#[test]
fn one_input_gives_one_result_however_many_threads() {
    let keyframes = capture(&Wrong { mount: wrong_mount(), ..Wrong::nothing() });
    let choice = CameraChoice::Given(TermSet { mount: true, image_poses: true, ..TermSet::default() });
    let with = |n: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| align(&keyframes, &choice)).unwrap()
    };
    assert_eq!(with(1), with(3));
}

/// Brightness that rises evenly, so that it and its slopes are exact between pixels.
fn evenly_lit(frame: &mut Frame) {
    let [width, height] = SIZE_PX.map(|side| side as usize);
    let value = |ix: usize| 40.0 + 0.5 * (ix % width) as f32 + 0.7 * (ix / width) as f32;
    frame.levels = vec![frame::Grey::new([width, height], 1.0, &(0..width * height).map(value).collect::<Vec<_>>())];
}

/// Differences between slopes of a pair's residuals and central differences, as shares of the largest slope of the term.
/// A few spots cross from one reading to the next and have a kink there: nine tenths are better than what comes back.
fn worst_slopes(rolls: bool) -> Vec<(layout::Term, f64, f64)> {
    const STEP: f64 = 1e-3; // Of what a term may be.
    let wrong = Wrong { noise: 0.0, rolls, ..Wrong::nothing() };
    let mut scene = Scene::new(&capture(&wrong), false).unwrap();
    scene.frames.iter_mut().for_each(evenly_lit);
    let all = candidates().into_iter().fold(TermSet::default(), TermSet::and);
    let layout = Layout::new(all, &scene.frames, 1);
    let mut here = Corrections::none(1);
    // Joints start at zero: their columns are those of the joints as read, to first order.
    let away = layout.terms.iter().enumerate().map(|(ix, term)| match term {
        layout::Term::Joint(_) => 0.0,
        term => 0.3 * term.scale() * (ix as f64 * 1.3).sin(),
    });
    here.take(&layout, &nalgebra::DVector::from_iterator(layout.n(), away));
    let tone = residual::Tone { gain: 0.9, offset: 4.0 };
    let pair = scene.pairs[scene.pairs.len() / 2];
    let how = sums::Looks {
        level: 0,
        hidden_frac: 0.1,
        noise: sums::Noise { photo: 1.0, depth: 1.0 },
        part: sums::Part::All,
    };
    let looked = |corrections: &Corrections| {
        let views = corrections.views(&scene.frames, &layout);
        let looks = sums::looks(sums::sides(&scene.frames, &views, pair), &scene.frames[pair.from].spots, &how);
        (looks, views)
    };
    let (looks, views) = looked(&here);
    let placed = [pair.from, pair.to].map(|ix| residual::Placed::new(&views[ix], |term| term));
    let worst = |ix: usize, term: layout::Term| {
        let nudged = |sign: f64| {
            let mut there = here.clone();
            let mut step = nalgebra::DVector::zeros(layout.n());
            step[ix] = sign * STEP * term.scale();
            there.take(&layout, &step);
            looked(&there).0
        };
        let (ahead, behind) = (nudged(1.0), nudged(-1.0));
        let mut row = vec![0.0; layout.n() + 2];
        let (mut slopes, mut off) = ([0.0f64; 2], [Vec::new(), Vec::new()]);
        for ((look, ahead), behind) in looks.iter().zip(&ahead).zip(&behind) {
            let (Some(look), Some(ahead), Some(behind)) = (look, ahead, behind) else { continue };
            let numeric = [ahead.photo(tone) - behind.photo(tone), ahead.depth() - behind.depth()];
            look.photo_slopes(&placed[0], &placed[1], tone, &mut row);
            let photo = row[ix];
            look.depth_slopes(&placed[0], &placed[1], &mut row);
            for (kind, slope) in [photo, row[ix]].into_iter().enumerate() {
                slopes[kind] = slopes[kind].max(slope.abs() * term.scale());
                off[kind].push((slope * term.scale() - numeric[kind] / (2.0 * STEP)).abs());
            }
        }
        let share = |kind: usize| {
            let off = &mut off[kind].clone();
            off.sort_by(f64::total_cmp);
            // A first joint changes nothing between images, and rounding of brightness to f32 is all there is.
            off[off.len() * 9 / 10] / slopes[kind].max([0.1, 1e-3][kind])
        };
        (term, share(0), share(1))
    };
    layout.terms.iter().enumerate().map(|(ix, term)| worst(ix, *term)).collect()
}

#[test]
fn slopes_match_central_differences() {
    const OFF: f64 = 0.01; // Readings are kept in f32, and the weight of one is held in the slope.
    // Left out: the lens moves points to other rows, and a mount elsewhere moves otherwise during the readout.
    const OFF_WHILE_ROLLING: f64 = 0.05;
    for (rolls, allowed) in [(false, OFF), (true, OFF_WHILE_ROLLING)] {
        let worst = worst_slopes(rolls);
        assert_eq!(worst.len(), if rolls { 23 } else { 22 });
        for (term, photo, depth) in &worst {
            assert!(*photo < allowed && *depth < allowed, "{term:?}: {photo:.4} {depth:.4} of {worst:.4?}");
        }
    }
}

#[test]
fn keyframes_without_depth_and_lone_ones_align_nothing() {
    let keyframes = capture(&Wrong::nothing());
    let choice = CameraChoice::Try(candidates());
    assert_eq!(align(&[], &choice), None);
    assert_eq!(align(&keyframes[..2], &choice), None);
    let flat = |keyframe: &Arc<Keyframe>| Arc::new(Keyframe { depth: None, ..keyframe.as_ref().clone() });
    assert_eq!(align(&keyframes.iter().map(flat).collect::<Vec<_>>(), &choice), None);
    // Test keyframes are not looked at: spoiling them changes nothing.
    let spoiled = |keyframe: &Arc<Keyframe>| match keyframe.split {
        Split::Test => Arc::new(Keyframe { world_from_camera: Transform::identity(), ..keyframe.as_ref().clone() }),
        Split::Train | Split::Selection => keyframe.clone(),
    };
    let given = CameraChoice::Given(TermSet { mount: true, ..TermSet::default() });
    assert_eq!(align(&keyframes, &given), align(&keyframes.iter().map(spoiled).collect::<Vec<_>>(), &given));
}

#[test]
fn drifting_images_are_moved_where_that_pays() {
    let keyframes: Vec<Arc<Keyframe>> = capture(&Wrong::nothing())
        .iter()
        .map(|keyframe| {
            // Errs by millimetres, smoothly, as a SLAM system does; nothing is known about the motion.
            let secs = keyframe.stamp.0 as f64 * 1e-9;
            let wave = |hz: f64, phase: f64| (6.3 * hz * secs + phase).sin();
            let drift = Transform::new(
                Vector3::new(wave(0.07, 0.0), wave(0.05, 1.0), wave(0.06, 2.0)) * 0.006,
                Vector3::new(wave(0.05, 0.5), wave(0.06, 1.5), wave(0.07, 2.5)) * 0.008,
            );
            let mut moved = keyframe.as_ref().clone();
            moved.world_from_camera *= drift;
            if let Some(depth) = &mut moved.depth {
                depth.world_from_camera =
                    moved.world_from_camera * keyframe.world_from_camera.inverse() * depth.world_from_camera;
            }
            (moved.twist, moved.joint_twists) = (None, [].into());
            Arc::new(moved)
        })
        .collect();
    let alignment = align(&keyframes, &CameraChoice::Try(candidates())).unwrap();
    let trial = alignment.trials.last().unwrap();
    let has_poses = matches!(trial.candidate, Candidate::Cameras(terms) if terms.image_poses);
    assert!(has_poses && trial.kept && trial.gain_db > 3.0, "{:?}", alignment.lines());
}

/// The capture with every pose but the test images' off on its own: millimetres along each axis, and a tenth of a degree each.
fn noisy(mm: f64, from_joints: bool) -> Vec<Arc<Keyframe>> {
    let moved = |(ix, keyframe): (usize, &Arc<Keyframe>)| {
        if keyframe.split == Split::Test {
            return keyframe.clone();
        }
        let axes = |stream: u64| Vector3::from_fn(|row, _| noise(7919 * ix as u64 + stream + row as u64 + 17));
        let off = Transform::new(axes(0) * 1e-3 * mm, axes(3) * (0.1 * mm).to_radians());
        let mut moved = keyframe.as_ref().clone();
        moved.world_from_camera *= off;
        if let Some(depth) = &mut moved.depth {
            depth.world_from_camera =
                moved.world_from_camera * keyframe.world_from_camera.inverse() * depth.world_from_camera;
        }
        if !from_joints {
            (moved.twist, moved.joint_twists) = (None, [].into());
        }
        Arc::new(moved)
    };
    capture(&Wrong::nothing()).iter().enumerate().map(moved).collect()
}

/// Pose errors relative to each other, after the common motion that takes most of them away: means, millimetres and degrees.
fn apart(found: &[Transform], right: &[Transform]) -> (f64, f64) {
    let mut common = Transform::identity();
    for _ in 0..10 {
        let left: Vec<Twist> = found
            .iter()
            .zip(right)
            .map(|(found, right)| transform::log(&(common * found * right.inverse()), 1.0))
            .collect();
        let n = left.len() as f64;
        let mean = Twist {
            linear_m_s: left.iter().map(|left| left.linear_m_s).sum::<Vector3<f64>>() / n,
            angular_rad_s: left.iter().map(|left| left.angular_rad_s).sum::<Vector3<f64>>() / n,
        };
        common = transform::exp(&mean, -1.0) * common;
    }
    let left = |(found, right): (&Transform, &Transform)| {
        let left = right.inverse() * common * found;
        (1e3 * left.translation.vector.norm(), left.rotation.angle().to_degrees())
    };
    let left: Vec<(f64, f64)> = found.iter().zip(right).map(left).collect();
    let mean = |of: fn(&(f64, f64)) -> f64| left.iter().map(of).sum::<f64>() / left.len() as f64;
    (mean(|left| left.0), mean(|left| left.1))
}

#[test]
fn images_that_err_on_their_own_are_moved_and_test_images_are_not() {
    let right = capture(&Wrong::nothing());
    for (mm, most_mm, most_degrees, from_joints) in
        [(2.0, 0.3, 0.02, false), (5.0, 0.3, 0.02, true), (10.0, 1.5, 0.2, true)]
    {
        let keyframes = noisy(mm, from_joints);
        let alignment = align(&keyframes, &CameraChoice::Try(candidates())).unwrap();
        assert!(alignment.has_image_poses(), "{mm} mm: {:?}", alignment.lines());
        let fix = &alignment.fixes["wrist"];
        let left = |split: Split| {
            let both = keyframes.iter().zip(&right).filter(|(keyframe, _)| keyframe.split == split);
            let (found, right): (Vec<Transform>, Vec<Transform>) =
                both.map(|(keyframe, right)| (fix.apply(keyframe).world_from_camera, right.world_from_camera)).unzip();
            apart(&found, &right)
        };
        for split in [Split::Train, Split::Selection] {
            let (left_mm, left_degrees) = left(split);
            assert!(left_mm < most_mm && left_degrees < most_degrees, "{mm} mm: {left_mm} mm, {left_degrees} degrees");
        }
        let (test_mm, test_degrees) = left(Split::Test);
        assert!(test_mm < 1e-6 && test_degrees < 1e-6, "{mm} mm of noise: test images were right: {test_mm} mm");
        assert!(fix.drift_share == 0.0, "{}", fix.drift_share);
    }
}
