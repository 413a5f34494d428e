//! Compares the calibrated pose of a camera with tags at known poses while a robot works, and
//! reports contradictions.
//!
//! Each image with a tag gives the pose of the camera relative to the world. A constant motion
//! separates this pose from the calibrated pose if the camera or the tag has moved. If the camera
//! has moved relative to its mount, the motion is constant in the frame of the camera. If the tag
//! has moved, the motion is constant in the world.

use crate::least_squares::sigma_of;
use kinematics::{Stamp, Transform, Twist, transform};
use nalgebra::{Matrix6, Vector6};
use std::collections::{BTreeSet, VecDeque};

/// Number of images at different poses before a contradiction is reported. Fewer images could have
/// the same error, for example due to a blurred tag.
const MIN_IMAGES: usize = 8;
/// Number of latest images that are compared. With more images, images from before and after a
/// movement would be averaged for a longer time.
const MAX_IMAGES: usize = 24;
/// Smaller differences are not reported, because measured tags and robots are rarely more accurate.
const MIN_TRANSLATION_M: f64 = 0.005;
const MIN_ROTATION_RAD: f64 = 0.0087;
/// A difference is significant if it is at least this multiple of its standard deviation. A single
/// test would need a smaller multiple. This check is repeated with every image for hours, and the
/// errors of images are not normally distributed.
const MIN_SIGMAS: f64 = 5.0;
/// If a camera moves less than these limits between two images, both images have the same errors.
/// The two images then count once, unless at least `MIN_STEP_SECS` have passed between them.
const MIN_STEP_M: f64 = 0.02;
const MIN_STEP_RAD: f64 = 0.05;
const MIN_STEP_SECS: f64 = 2.0;
/// Length that makes a rotation comparable with a translation, meters. It is a usual distance of a
/// tag.
const ARM_M: f64 = 0.4;
/// An explanation counts as better than the other explanation if its residuals are smaller by this
/// factor.
const CLEARER: f64 = 2.0;

/// Observation of the pose of a camera in one image.
#[derive(Clone, Debug, PartialEq)]
pub struct TagObservation {
    /// Stamp of the image.
    pub stamp: Stamp,
    /// Pose of the camera according to calibration and robot.
    pub calibrated: Transform,
    /// Pose of the camera according to the tags. Like the calibrated pose, it is
    /// `world_from_camera`.
    pub seen: Transform,
    /// Covariance of `seen` for a small motion in camera axes: meters, then radians.
    pub covariance: Matrix6<f64>,
    /// The visible tags.
    pub tags: Vec<u32>,
}

/// Compares the calibrated pose of one camera with tags.
#[derive(Debug)]
pub struct TagCheck {
    camera: String,
    observations: VecDeque<TagObservation>,
    is_reported: bool,
}

/// Tags that contradict a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct TagContradiction {
    /// Name of the camera.
    pub camera: String,
    /// The tags, in ascending order.
    pub tags: Vec<u32>,
    /// Number of images at different poses.
    pub n_images: usize,
    /// Angle between the calibrated and the observed camera pose and its standard deviation,
    /// radians.
    pub rotation_rad: [f64; 2],
    /// Distance between the calibrated and the observed camera position and its standard deviation,
    /// meters.
    pub translation_m: [f64; 2],
    /// What has moved.
    pub cause: ContradictionCause,
}

/// The likely cause of a contradiction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ContradictionCause {
    /// The difference is constant in the frame of the camera.
    Camera,
    /// The difference is constant in the world.
    Tag,
    /// The robot has not moved enough to tell.
    Unknown,
}

impl TagCheck {
    /// A check of a camera.
    pub fn new(camera: &str) -> Self {
        Self {
            camera: camera.to_owned(),
            observations: VecDeque::new(),
            is_reported: false,
        }
    }

    /// Adds an image. Returns a contradiction once, when it becomes significant.
    pub fn push(&mut self, observation: TagObservation) -> Option<TagContradiction> {
        if self.is_reported
            || self
                .observations
                .back()
                .is_some_and(|last| is_same_view(last, &observation))
        {
            return None;
        }
        self.observations.push_back(observation);
        if self.observations.len() > MAX_IMAGES {
            self.observations.pop_front();
        }
        let contradiction = self.contradiction()?;
        self.is_reported = true;
        Some(contradiction)
    }

    /// Residuals of a prediction of all images.
    fn residuals(&self, predicted: impl Fn(&TagObservation) -> Transform) -> Vec<Vector6<f64>> {
        self.observations
            .iter()
            .map(|observation| twist(&(predicted(observation).inverse() * observation.seen)))
            .collect()
    }

    /// The contradiction in the images so far, if it is significant.
    fn contradiction(&self) -> Option<TagContradiction> {
        let n = self.observations.len();
        if n < MIN_IMAGES {
            return None;
        }
        // There are two explanations: the motion is constant in the frame of the camera, or in the
        // world.
        let in_camera =
            |observation: &TagObservation| observation.calibrated.inverse() * observation.seen;
        let in_world =
            |observation: &TagObservation| observation.seen * observation.calibrated.inverse();
        let mean_in_camera = mean(self.observations.iter().map(in_camera))?;
        let mean_in_world = mean(self.observations.iter().map(in_world))?;
        let of_camera = self.residuals(|observation| observation.calibrated * mean_in_camera);
        let of_world = self.residuals(|observation| mean_in_world * observation.calibrated);
        let [squares_of_camera, squares_of_world] =
            [&of_camera, &of_world].map(|residuals| squares(residuals));
        let cause = if squares_of_camera * CLEARER.powi(2) < squares_of_world {
            ContradictionCause::Camera
        } else if squares_of_world * CLEARER.powi(2) < squares_of_camera {
            ContradictionCause::Tag
        } else {
            ContradictionCause::Unknown
        };
        // The variance is the larger of two values: the scatter about the better explanation, and
        // the stated noise. The stated noise is larger if the robot stands still.
        let residuals = if squares_of_camera <= squares_of_world {
            &of_camera
        } else {
            &of_world
        };
        let stated = self
            .observations
            .iter()
            .map(|observation| observation.covariance)
            .sum::<Matrix6<f64>>()
            / n as f64;
        let scatter = residuals
            .iter()
            .map(|residual| residual * residual.transpose())
            .sum::<Matrix6<f64>>()
            / (n - 1) as f64;
        // If a tag has moved, its motion is expressed in different camera axes at each pose. The
        // axes of the latest image are used.
        let latest = self.observations.back()?.calibrated;
        let difference = if squares_of_camera <= squares_of_world {
            twist(&mean_in_camera)
        } else {
            twist(&(latest.inverse() * mean_in_world * latest))
        };
        let mean_covariance = (scatter + stated) / n as f64;
        let translation_m = norm_with_sigma(&difference, &mean_covariance, 0)?;
        let rotation_rad = norm_with_sigma(&difference, &mean_covariance, 3)?;
        let is_significant =
            |[value, sigma]: [f64; 2], min: f64| value > min && value > MIN_SIGMAS * sigma;
        let is_off = is_significant(translation_m, MIN_TRANSLATION_M)
            || is_significant(rotation_rad, MIN_ROTATION_RAD);
        let tags: BTreeSet<u32> = self
            .observations
            .iter()
            .flat_map(|observation| observation.tags.clone())
            .collect();
        is_off.then(|| TagContradiction {
            camera: self.camera.clone(),
            tags: tags.into_iter().collect(),
            n_images: n,
            rotation_rad,
            translation_m,
            cause,
        })
    }
}

/// Norm of three components of a vector, starting with `first`, and its standard deviation. `None`
/// if they are zero.
fn norm_with_sigma(
    vector: &Vector6<f64>,
    covariance: &Matrix6<f64>,
    first: usize,
) -> Option<[f64; 2]> {
    let part = vector.fixed_rows::<3>(first).into_owned();
    let direction = part.try_normalize(0.0)?;
    let variance =
        (direction.transpose() * covariance.fixed_view::<3, 3>(first, first) * direction)[0];
    Some([part.norm(), sigma_of(variance)])
}

/// Whether an image adds nothing to an earlier image.
fn is_same_view(a: &TagObservation, b: &TagObservation) -> bool {
    let motion = a.calibrated.inverse() * b.calibrated;
    motion.translation.vector.norm() < MIN_STEP_M
        && motion.rotation.angle() < MIN_STEP_RAD
        && b.stamp.secs_since(a.stamp) < MIN_STEP_SECS
}

/// Mean of similar transforms.
fn mean(transforms: impl Iterator<Item = Transform>) -> Option<Transform> {
    let transforms: Vec<Transform> = transforms.collect();
    let first = transforms.first()?;
    let sum: Vector6<f64> = transforms
        .iter()
        .map(|other| twist(&(first.inverse() * other)))
        .sum();
    let mean = sum / transforms.len() as f64;
    let mean = Twist {
        linear_m_s: mean.fixed_rows::<3>(0).into_owned(),
        angular_rad_s: mean.fixed_rows::<3>(3).into_owned(),
    };
    Some(first * transform::exp(&mean, 1.0))
}

/// The motion as a vector of the translation, then the rotation.
fn twist(motion: &Transform) -> Vector6<f64> {
    let Twist {
        linear_m_s: linear,
        angular_rad_s: angular,
    } = transform::log(motion, 1.0);
    Vector6::new(
        linear.x, linear.y, linear.z, angular.x, angular.y, angular.z,
    )
}

/// Sum of the squared lengths of residuals, square meters.
fn squares(residuals: &[Vector6<f64>]) -> f64 {
    let square = |residual: &Vector6<f64>| {
        residual.fixed_rows::<3>(0).norm_squared()
            + (ARM_M * residual.fixed_rows::<3>(3)).norm_squared()
    };
    residuals.iter().map(square).sum()
}

impl std::fmt::Display for TagContradiction {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            camera,
            tags,
            n_images,
            ..
        } = self;
        let names: Vec<String> = tags.iter().map(u32::to_string).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let tags = format!(
            "{} {}",
            if names.len() == 1 { "tag" } else { "tags" },
            messages::listed(&names, "and")
        );
        let [angle, angle_sigma] = self.rotation_rad.map(f64::to_degrees);
        let [mm, mm_sigma] = self.translation_m.map(|m| 1e3 * m);
        let off =
            format!("by {angle:.1} +- {angle_sigma:.1} degrees and {mm:.0} +- {mm_sigma:.0} mm");
        let calibrate =
            "stop and check its mount, then calibrate it again with `fieldrig calibrate`";
        match self.cause {
            ContradictionCause::Camera => write!(
                f,
                "camera {camera:?} is off {off} according to {tags} in {n_images} images: it has moved relative to its mount, or its parent_from_camera is wrong; {calibrate}"
            ),
            ContradictionCause::Tag => write!(
                f,
                "camera {camera:?} sees {tags} in another place than the rig file gives ({off}, {n_images} images), but always in the same one: move the tags back, or measure world_from_tag again"
            ),
            ContradictionCause::Unknown => write!(
                f,
                "camera {camera:?} is off {off} according to {tags} in {n_images} images: it or a tag has moved, or parent_from_camera or world_from_tag is wrong; check the tags; if they are in place, {calibrate}"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use numbers::random::Random;

    const SIGMA_M: f64 = 0.0005;
    const SIGMA_RAD: f64 = 0.002;

    /// Runs a check with poses around a tag. `seen` returns the true camera pose for a calibrated
    /// camera pose.
    fn run(
        n: usize,
        moves: bool,
        seen: impl Fn(&Transform) -> Transform,
    ) -> Option<(usize, TagContradiction)> {
        let mut random = Random::new(7);
        let mut check = TagCheck::new("wrist");
        for ix in 0..n {
            let spread = if moves { 1.0 } else { 0.0 };
            let mut vector = |scale: f64| {
                Vector3::new(random.normal(), random.normal(), random.normal()) * scale
            };
            let calibrated = Transform::new(
                Vector3::new(0.5, 0.0, 0.4) + vector(0.1 * spread),
                Vector3::new(3.0, 0.0, 0.0) + vector(0.3 * spread),
            );
            let noise = Transform::new(vector(SIGMA_M), vector(SIGMA_RAD));
            let variances =
                Vector6::new(SIGMA_M, SIGMA_M, SIGMA_M, SIGMA_RAD, SIGMA_RAD, SIGMA_RAD)
                    .map(|s| s * s);
            let observation = TagObservation {
                stamp: Stamp(0).plus_secs(3.0 * ix as f64),
                calibrated,
                seen: seen(&calibrated) * noise,
                covariance: Matrix6::from_diagonal(&variances),
                tags: vec![7],
            };
            if let Some(found) = check.push(observation) {
                return Some((ix + 1, found));
            }
        }
        None
    }

    #[test]
    fn right_calibration_is_not_reported() {
        assert_eq!(run(500, true, |calibrated| *calibrated), None);
        assert_eq!(run(500, false, |calibrated| *calibrated), None);
        // Small errors are usual.
        assert_eq!(
            run(500, true, |calibrated| calibrated
                * Transform::translation(0.003, 0.0, 0.0)),
            None
        );
    }

    #[test]
    fn moved_camera_is_reported_with_its_motion() {
        let moved = Transform::new(Vector3::new(0.01, 0.0, 0.005), Vector3::new(0.0, 0.03, 0.0));
        let (n, found) = run(100, true, |calibrated| calibrated * moved).expect("a contradiction");
        assert!(n <= MIN_IMAGES + 2, "{n}");
        assert_eq!(
            (found.cause, found.tags.as_slice()),
            (ContradictionCause::Camera, &[7][..])
        );
        assert!(
            (found.rotation_rad[0] - 0.03).abs() < 0.003 && found.rotation_rad[1] < 0.002,
            "{found:?}"
        );
        assert!((found.translation_m[0] - 0.0112).abs() < 0.002, "{found:?}");
        let text = found.to_string();
        assert!(
            text.starts_with("camera \"wrist\" is off by 1.7 +- 0.")
                && text.contains("according to tag 7"),
            "{text}"
        );
        assert!(
            text.contains("it has moved relative to its mount"),
            "{text}"
        );
    }

    #[test]
    fn moved_tag_is_distinguished_from_a_moved_camera() {
        let moved = Transform::new(Vector3::new(0.03, 0.01, 0.0), Vector3::new(0.0, 0.0, 0.1));
        let (_, found) = run(100, true, |calibrated| moved * calibrated).expect("a contradiction");
        assert_eq!(found.cause, ContradictionCause::Tag, "{found}");
        assert!(
            found.to_string().contains("measure world_from_tag again"),
            "{found}"
        );
        // A robot that stands still sees no difference.
        let (_, found) = run(100, false, |calibrated| moved * calibrated).expect("a contradiction");
        assert_eq!(found.cause, ContradictionCause::Unknown, "{found}");
    }

    /// In camera axes, the motion of the tag has a different direction at each pose, so its mean
    /// would be far too small.
    #[test]
    fn moved_tag_is_measured_in_the_world_while_the_wrist_rotates() {
        for moved in [
            Transform::translation(0.04, 0.0, 0.0),
            Transform::new(Vector3::new(0.0, 0.04, 0.0), Vector3::new(0.0, 0.0, 0.02)),
        ] {
            let mut check = TagCheck::new("wrist");
            let angles = [-90.0_f64, 90.0].into_iter().cycle().map(f64::to_radians);
            let found = angles.take(40).enumerate().find_map(|(ix, angle)| {
                // The camera rotates about its viewing direction, straight above the origin of the
                // world.
                let down = Transform::new(
                    Vector3::new(0.0, 0.0, 0.4),
                    Vector3::x() * std::f64::consts::PI,
                );
                let calibrated = down * Transform::new(Vector3::zeros(), Vector3::z() * angle);
                check.push(TagObservation {
                    stamp: Stamp(0).plus_secs(3.0 * ix as f64),
                    calibrated,
                    seen: moved * calibrated,
                    covariance: Matrix6::identity() * 1e-7,
                    tags: vec![7],
                })
            });
            let found = found.expect("the tag has moved by 40 mm");
            assert_eq!(found.cause, ContradictionCause::Tag, "{found}");
            assert!(
                (found.rotation_rad[0] - moved.rotation.angle()).abs() < 1e-3,
                "{found:?}"
            );
            // A rotation about the origin of the world usually also moves the camera. It does not
            // move the camera if the camera is straight above the origin.
            assert!((found.translation_m[0] - 0.04).abs() < 1e-3, "{found:?}");
        }
    }

    #[test]
    fn images_of_the_same_view_count_once() {
        let mut check = TagCheck::new("wrist");
        let moved = Transform::translation(0.05, 0.0, 0.0);
        for ix in 0..100 {
            let observation = TagObservation {
                stamp: Stamp(0).plus_secs(0.01 * f64::from(ix)),
                calibrated: Transform::identity(),
                seen: moved,
                covariance: Matrix6::identity() * 1e-8,
                tags: vec![1],
            };
            assert_eq!(
                check.push(observation),
                None,
                "one second with the same view"
            );
        }
    }
}
