//! Detection of a camera that has moved relative to its mount.
//!
//! Each new image is compared with reference images, which are older than the last
//! [`MOVEMENT_WINDOW`] images of its camera. If the camera has not moved, a motion that is
//! estimated from some new images does not improve the prediction of the next image. If it has
//! moved, one motion explains all images since the movement.
//!
//! The test is a Shiryaev-Roberts e-detector (Shin, Ramdas and Rinaldo 2022), so it may be repeated
//! with every image. For each possible start of the movement, the detector estimates a motion from
//! the images since this start. It bets that this motion improves the prediction of each later
//! image. After each bet, its stake is multiplied by a factor. If the camera has not moved, this
//! factor is at most 1 on average. The probability that the sum of all stakes reaches [`ALARM`]
//! within `n` images is therefore at most `n / ALARM`.

use super::corrections::Corrections;
use super::fit;
use super::layout::Layout;
use super::pairs::{self, Pair};
use super::poses;
use super::prepared_image::PreparedImage;
use super::solve::Solution;
use super::sums::{self, Noise, PixelSubset, ResidualOptions};
use super::validation;
use super::view::CorrectedView;
use crate::{CameraCorrection, rigid_transform};
use keyframe::{Keyframe, Split};
use kinematics::{Transform, transform};
use nalgebra::{DVector, Matrix6, Vector3, Vector6};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Number of latest images of a camera that are considered as the start of a movement.
pub const MOVEMENT_WINDOW: usize = 16;
/// Maximum number of reference images. If there are more, every second reference image is dropped.
/// The time to choose partners for an image grows with the number of reference images.
const MAX_REFERENCES: usize = 48;
/// Maximum and minimum number of reference images with which an image is compared.
const MAX_PARTNERS: usize = 6;
const MIN_PARTNERS: usize = 2;
/// Sum of stakes at which a movement is reported. The probability of a false alarm in 1000 images
/// is then at most 1 %.
const ALARM: f64 = 1e5;
/// Fraction of the stake that is bet on each image. With a larger bet, movements are detected with
/// fewer images, but one bad image loses most of the stake.
const BET_FRAC: f64 = 0.8;
/// Prediction gain that is ignored, dB. A motion may improve the prediction of neighboring images
/// by this gain because of other calibration errors.
const MARGIN_DB: f64 = 0.2;
/// Losses are clamped to this value, dB. Without a limit, the factor on the stake could become
/// negative.
const MAX_LOSS_DB: f64 = 0.5;
/// Smaller movements are not reported, because they may be due to other calibration errors.
const MIN_ROTATION_RAD: f64 = 0.005;
const MIN_TRANSLATION_M: f64 = 0.003;
/// Minimum share of the individual motions that a movement explains. Other calibration errors move
/// each image differently.
const MIN_EXPLAINED_FRAC: f64 = 0.9;

/// Movement of a camera relative to its mount.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraMovement {
    /// Name of the camera.
    pub camera: String,
    /// Stamp of the first image after the movement, nanoseconds.
    pub since_nanos: i64,
    /// Time from the first keyframe to the first image after the movement, seconds.
    pub since_secs: f64,
    /// Rotation vector (radians) and translation (meters) of the correction for images since the
    /// movement, as in [`CameraCorrection`]. It is applied before all other corrections.
    pub rotation_rad: [f64; 3],
    /// See `rotation_rad`.
    pub translation_m: [f64; 3],
    /// Standard deviations of the angle of rotation and of the length of the translation.
    pub rotation_sigma_rad: f64,
    /// See `rotation_sigma_rad`.
    pub translation_sigma_m: f64,
    /// Number of images from which the movement was estimated.
    pub n_images: usize,
}

impl CameraMovement {
    /// The correction for images from then on.
    pub(super) fn correction(&self) -> Transform {
        rigid_transform(self.rotation_rad.into(), self.translation_m.into())
    }
}

impl std::fmt::Display for CameraMovement {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let motion = self.correction().inverse();
        write!(
            f,
            "camera {:?} has moved by {:.1} degrees and {:.0} mm relative to its mount since {:.1} s; images since then are corrected",
            self.camera,
            motion.rotation.angle().to_degrees(),
            1e3 * motion.translation.vector.norm(),
            self.since_secs
        )
    }
}

/// An image in the detector.
#[derive(Debug, Default)]
struct ImageState {
    is_reference: bool,
    /// Individual motion of the camera relative to the reference images (meters, then radians) and
    /// its information. `None` if the image and the references show no common surfaces.
    motion: Option<(Vector6<f64>, Matrix6<f64>)>,
    /// Stake of the bets on a movement that began with this image.
    stake: f64,
}

/// Detects movements of cameras in a sequence of keyframes. The result depends only on the
/// keyframes and their order.
#[derive(Debug)]
pub struct MovementDetector {
    images: Vec<PreparedImage>,
    views: Vec<CorrectedView>,
    states: Vec<ImageState>,
}

impl MovementDetector {
    /// A detector that compares later keyframes with `references`. The cameras of the references
    /// must already be corrected.
    pub fn new(references: &[Arc<Keyframe>]) -> Self {
        let used: Vec<_> = references
            .iter()
            .filter(|keyframe| is_used(keyframe))
            .collect();
        let n = used.len().min(MAX_REFERENCES);
        let images: Vec<_> = (0..n)
            .into_par_iter()
            .filter_map(|ix| PreparedImage::new(used[ix * used.len() / n], 0))
            .collect();
        let mut detector = Self {
            images: Vec::new(),
            views: Vec::new(),
            states: Vec::new(),
        };
        for image in images {
            detector.add(
                image,
                ImageState {
                    is_reference: true,
                    ..ImageState::default()
                },
            );
        }
        detector
    }

    /// Tests the next keyframe, which has the same corrections as the references. Returns a
    /// movement if one is detected. The caller must then create a new detector. The movement
    /// applies to the corrected keyframes.
    pub fn push(&mut self, keyframe: &Arc<Keyframe>) -> Option<CameraMovement> {
        let image = is_used(keyframe)
            .then(|| PreparedImage::new(keyframe, 0))
            .flatten()?;
        self.add(
            image,
            ImageState {
                stake: 1.0,
                ..ImageState::default()
            },
        );
        let ix = self.images.len() - 1;
        // Only reference images are partners, because recent images may have been taken after the
        // movement.
        let pairs = pairs::choose(
            &self.images,
            &self.views,
            &self.references(),
            &[ix],
            MAX_PARTNERS,
        );
        let recent = self.recent(&keyframe.camera);
        if pairs.len() >= MIN_PARTNERS {
            self.bet(ix, &pairs, &recent);
        }
        let sum = recent.iter().map(|ix| self.states[*ix].stake).sum::<f64>();
        log::debug!(
            "movement of camera {:?}: sum of stakes {sum:.3e}",
            keyframe.camera
        );
        if sum >= ALARM {
            if let Some(movement) = self.movement(&recent) {
                return Some(movement);
            }
            // A rejected movement would be found again with the next image.
            recent.iter().for_each(|ix| self.states[*ix].stake = 1.0);
        }
        // If there is no movement, the window moves on and its oldest image becomes a reference.
        if recent.len() > MOVEMENT_WINDOW {
            self.states[recent[0]] = ImageState {
                is_reference: true,
                ..ImageState::default()
            };
        }
        self.thin_references();
        None
    }

    /// Adds an image with its view.
    fn add(&mut self, image: PreparedImage, state: ImageState) {
        if let Some(view) =
            CorrectedView::new(&image, &CameraCorrection::default(), &Layout::default())
        {
            self.images.push(image);
            self.views.push(view);
            self.states.push(state);
        }
    }

    fn references(&self) -> Vec<usize> {
        (0..self.images.len())
            .filter(|ix| self.states[*ix].is_reference)
            .collect()
    }

    /// The images of a camera that are not references, in order of arrival.
    fn recent(&self, camera: &str) -> Vec<usize> {
        let is_recent = |ix: &usize| {
            !self.states[*ix].is_reference && *self.images[*ix].keyframe.camera == *camera
        };
        (0..self.images.len()).filter(is_recent).collect()
    }

    /// Bets on an image, then estimates its own motion.
    fn bet(&mut self, ix: usize, pairs: &[Pair], recent: &[usize]) {
        // Each bet is placed before the image is used, so its motion is predicted only from earlier
        // images. Otherwise, the factor would exceed 1 on average.
        let Some(noise) = self.noise(pairs) else {
            return;
        };
        for (position, start) in recent.iter().enumerate().filter(|(_, start)| **start != ix) {
            let Some(motion) = self.mean_motion(&recent[position..]) else {
                continue;
            };
            let Some(gain_db) = self.gain_db(pairs, noise, &motion) else {
                continue;
            };
            self.states[*start].stake *= factor(gain_db);
        }
        self.states[ix].motion = self.own_motion(ix, pairs);
    }

    /// Noise of the residuals of pairs, without a motion.
    fn noise(&self, pairs: &[Pair]) -> Option<Noise> {
        sums::noise_of(&sums::of_free_pairs(
            &self.images,
            &self.views,
            pairs,
            &finest(fit::INITIAL_NOISE),
        ))
    }

    /// Motion of the camera at one image relative to the reference images, and its information.
    fn own_motion(&self, ix: usize, pairs: &[Pair]) -> Option<(Vector6<f64>, Matrix6<f64>)> {
        let correction = poses::fit_one(
            &self.images,
            &self.views,
            pairs,
            &CameraCorrection::default(),
            PixelSubset::All,
        )?;
        let image = &self.images[ix];
        let view = CorrectedView::new(image, &correction, &Layout::default())?;
        let mut views = self.views.clone();
        views[ix] = view;
        let sums = |noise| sums::of_free_pairs(&self.images, &views, pairs, &finest(noise));
        let noise = sums::noise_of(&sums(fit::INITIAL_NOISE))?;
        let information = sums(noise)
            .iter()
            .map(|pair| pair.information.fixed_view::<6, 6>(6, 6).into_owned())
            .sum();
        let [a, b, c, x, y, z] = correction.drift_at(image.keyframe.stamp);
        let twist = transform::log(
            &rigid_transform([a, b, c].into(), [x, y, z].into()).inverse(),
            1.0,
        );
        let linear = twist.linear_m_s;
        let angular = twist.angular_rad_s;
        Some((
            Vector6::new(
                linear.x, linear.y, linear.z, angular.x, angular.y, angular.z,
            ),
            information,
        ))
    }

    /// Mean of the motions of several images, weighted by their information.
    fn mean_motion(&self, ixs: &[usize]) -> Option<Vector6<f64>> {
        let mut information = Matrix6::zeros();
        let mut weighted = Vector6::zeros();
        for (motion, weight) in ixs.iter().filter_map(|ix| self.states[*ix].motion.as_ref()) {
            information += weight;
            weighted += weight * motion;
        }
        information
            .try_inverse()
            .map(|covariance| covariance * weighted)
    }

    /// Share of the individual motions that their mean explains, weighted by information.
    fn explained_frac(&self, ixs: &[usize]) -> Option<f64> {
        let mean = self.mean_motion(ixs)?;
        Some(1.0 - self.squares(ixs, &mean) / self.squares(ixs, &Vector6::zeros()))
    }

    /// Sum of the squared differences of individual motions from a motion, weighted by information.
    fn squares(&self, ixs: &[usize], motion: &Vector6<f64>) -> f64 {
        ixs.iter()
            .filter_map(|ix| self.states[*ix].motion.as_ref())
            .map(|(own, weight)| (own - motion).dot(&(weight * (own - motion))))
            .sum::<f64>()
    }

    /// Gain in the prediction of an image from reference images if its camera has moved by
    /// `motion`, dB. `None` if too few samples are visible.
    fn gain_db(&self, pairs: &[Pair], noise: Noise, motion: &Vector6<f64>) -> Option<f64> {
        let ix = pairs.first()?.to;
        let moved =
            CorrectedView::new(&self.images[ix], &correction_of(motion), &Layout::default())?;
        validation::gain_db(&self.images, &self.views, pairs, &moved, noise)
    }

    /// The movement that explains the recent images of a camera. `None` if it is too small or
    /// explains too little.
    fn movement(&mut self, recent: &[usize]) -> Option<CameraMovement> {
        // The start with the largest stake gives a first estimate of the motion.
        let stake = |position: &usize| self.states[recent[*position]].stake;
        let start = (0..recent.len()).max_by(|one, other| stake(one).total_cmp(&stake(other)))?;
        let motion = self.mean_motion(&recent[start..])?;
        // The first image from which on the motion improves predictions the most.
        let references = self.references();
        let pairs_of = |ix: &usize| {
            pairs::choose(&self.images, &self.views, &references, &[*ix], MAX_PARTNERS)
        };
        let pairs: Vec<Vec<Pair>> = recent.iter().map(pairs_of).collect();
        let gain = |pairs: &Vec<Pair>| self.gain_db(pairs, self.noise(pairs)?, &motion);
        let gains: Vec<f64> = pairs
            .iter()
            .map(|pairs| gain(pairs).unwrap_or(0.0))
            .collect();
        // Gains are clamped, so that one image with a large gain does not decide alone.
        let clamped: Vec<f64> = gains.iter().map(|gain| gain.clamp(-1.0, 1.0)).collect();
        let since = |position: &usize| clamped[*position..].iter().sum::<f64>();
        let start = (0..recent.len()).max_by(|one, other| since(one).total_cmp(&since(other)))?;
        let moved = &recent[start..];
        let explained_frac = self.explained_frac(moved)?;
        let found = self.register_moved(moved, &pairs[start..].concat(), &motion)?;
        let CameraCorrection {
            rotation_rad,
            translation_m,
            ..
        } = found.corrections.by_camera[1];
        let first = &self.images[moved[0]].keyframe;
        let movement = CameraMovement {
            camera: first.camera.to_string(),
            since_nanos: first.stamp.0,
            since_secs: 0.0,
            rotation_rad,
            translation_m,
            rotation_sigma_rad: sigma_along(&found.solution, rotation_rad, 3),
            translation_sigma_m: sigma_along(&found.solution, translation_m, 0),
            n_images: moved.len(),
        };
        log::debug!(
            "{movement:?}, gains {gains:.2?} dB, {explained_frac:.3} of the motions explained"
        );
        let is_large = Vector3::from(rotation_rad).norm() > MIN_ROTATION_RAD
            || Vector3::from(translation_m).norm() > MIN_TRANSLATION_M;
        (is_large && explained_frac > MIN_EXPLAINED_FRAC).then_some(movement)
    }

    /// Registers all moved images together against the references, starting with a motion. The
    /// moved images are treated as images of a second camera, whose extrinsics are estimated.
    fn register_moved(
        &mut self,
        moved: &[usize],
        pairs: &[Pair],
        motion: &Vector6<f64>,
    ) -> Option<fit::Fit> {
        for ix in moved {
            self.images[*ix].camera = 1;
        }
        let mut initial = Corrections::none(2);
        initial.by_camera[1] = correction_of(motion);
        let found = fit::fit(&self.images, pairs, Layout::extrinsics_of(1), &initial);
        // If the movement is rejected, these images become references.
        for ix in moved {
            self.images[*ix].camera = 0;
        }
        found
    }

    /// Drops every second reference image if there are too many.
    fn thin_references(&mut self) {
        let references = self.references();
        if references.len() <= MAX_REFERENCES {
            return;
        }
        for ix in references.into_iter().skip(1).step_by(2).rev() {
            self.images.remove(ix);
            self.views.remove(ix);
            self.states.remove(ix);
        }
    }
}

/// Standard deviation of a vector along itself, whose parameters start at `begin`.
fn sigma_along(solution: &Solution, vector: [f64; 3], begin: usize) -> f64 {
    let axis = Vector3::from(vector)
        .try_normalize(0.0)
        .unwrap_or_else(Vector3::zeros);
    let mut weights = DVector::zeros(6);
    weights.rows_mut(begin, 3).copy_from(&axis);
    solution.variance(&weights).sqrt()
}

fn is_used(keyframe: &Keyframe) -> bool {
    keyframe.split != Split::Test && keyframe.depth.is_some()
}

/// Options for residuals of all pixels at the finest level. Coarser levels are not needed, because
/// new images are already aligned approximately.
fn finest(noise: Noise) -> ResidualOptions {
    ResidualOptions {
        level: 0,
        occlusion_frac: fit::OCCLUSION_FRAC[0],
        noise,
        part: PixelSubset::All,
    }
}

/// Factor on the stake of a bet after an image whose prediction has improved by `gain_db`.
fn factor(gain_db: f64) -> f64 {
    1.0 + BET_FRAC * (gain_db.max(-MAX_LOSS_DB) - MARGIN_DB) / (MAX_LOSS_DB + MARGIN_DB)
}

/// The correction for a motion of the camera in its own axes (meters, then radians).
fn correction_of(motion: &Vector6<f64>) -> CameraCorrection {
    let twist = kinematics::Twist {
        linear_m_s: motion.fixed_rows::<3>(0).into_owned(),
        angular_rad_s: motion.fixed_rows::<3>(3).into_owned(),
    };
    let (rotation_rad, translation_m) =
        super::corrections::rotation_and_translation(&transform::exp(&twist, -1.0));
    CameraCorrection {
        rotation_rad,
        translation_m,
        ..CameraCorrection::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::{Miscalibration, capture, wrong_extrinsics};

    const N_REFERENCES: usize = 20;
    /// Index of the first image after the movement.
    const MOVED_AT: usize = 26;

    /// Tests the images after the references. Returns the movement, and the number of images until
    /// it was found.
    fn detect(keyframes: &[Arc<Keyframe>]) -> Option<(CameraMovement, usize)> {
        let mut detector = MovementDetector::new(&keyframes[..N_REFERENCES]);
        let mut later = keyframes.iter().enumerate().skip(N_REFERENCES);
        later.find_map(|(ix, keyframe)| Some((detector.push(keyframe)?, ix + 1)))
    }

    /// A scan during which the camera is moved relative to its mount.
    fn scan_with_movement(motion: &Transform, noise: f64) -> Vec<Arc<Keyframe>> {
        let before = capture(&Miscalibration {
            noise,
            ..Miscalibration::none()
        });
        let after = capture(&Miscalibration {
            noise,
            extrinsics: motion.inverse(),
            ..Miscalibration::none()
        });
        [&before[..MOVED_AT], &after[MOVED_AT..]].concat()
    }

    #[test]
    fn movement_is_found_and_estimated() {
        let large = Transform::new(
            Vector3::new(-0.004, 0.003, 0.004),
            Vector3::new(0.02, -0.025, 0.018),
        );
        for (motion, noise, max_images) in [
            (wrong_extrinsics(), 1.0, 8),
            (large, 1.0, 7),
            (large, 3.0, 8),
        ] {
            let keyframes = scan_with_movement(&motion, noise);
            let (movement, n_seen) = detect(&keyframes).expect("a movement");
            assert!(
                n_seen - MOVED_AT <= max_images,
                "found after {} images",
                n_seen - MOVED_AT
            );
            let since = keyframes
                .iter()
                .position(|keyframe| keyframe.stamp.0 == movement.since_nanos);
            assert_eq!(since, Some(MOVED_AT), "{movement:?}");
            let left = movement.correction() * motion;
            let (degrees, mm) = (
                left.rotation.angle().to_degrees(),
                1e3 * left.translation.vector.norm(),
            );
            assert!(
                degrees < 0.05 && mm < 0.7,
                "{degrees} degrees, {mm} mm left of {motion:?}"
            );
            assert!(
                movement.rotation_sigma_rad < 1e-3 && movement.translation_sigma_m < 1e-3,
                "{movement:?}"
            );
        }
    }

    #[test]
    fn undisturbed_scans_have_no_movement() {
        let none = Miscalibration::none();
        let mut scans: Vec<Miscalibration> = (2..14)
            .zip([0.5, 1.0, 3.0].into_iter().cycle())
            .map(|(seed, noise)| Miscalibration {
                seed,
                noise,
                ..none.clone()
            })
            .collect();
        // Errors that registration has not corrected yet.
        scans.extend(
            [0.003, 0.006, -0.006, 0.01].map(|time_offset_secs| Miscalibration {
                time_offset_secs,
                ..none.clone()
            }),
        );
        scans.extend([0.002, -0.003].map(|error| Miscalibration {
            joints: [error, -error, error, 0.0],
            ..none.clone()
        }));
        let slight = Transform::new(
            Vector3::new(0.0005, -0.0005, 0.0005),
            Vector3::new(0.001, 0.002, -0.001),
        );
        scans.extend([1, 2].map(|seed| Miscalibration {
            extrinsics: slight,
            seed,
            ..none.clone()
        }));
        assert_eq!(scans.len(), 20);
        for scan in scans {
            let found = detect(&capture(&scan));
            assert!(
                found.is_none(),
                "{found:?}, seed {}, time offset {} s, joints {:?}",
                scan.seed,
                scan.time_offset_secs,
                scan.joints
            );
        }
    }

    #[test]
    fn images_that_cannot_be_compared_are_skipped() {
        let keyframes = capture(&Miscalibration::none());
        let mut detector = MovementDetector::new(&keyframes[1..2]);
        let without_depth = Arc::new(Keyframe {
            depth: None,
            ..keyframes[30].as_ref().clone()
        });
        assert_eq!(detector.push(&without_depth), None);
        let far =
            Arc::new(keyframes[30].with_base_correction(&Transform::translation(50.0, 0.0, 0.0)));
        assert_eq!(detector.push(&far), None);
        assert_eq!(
            detector.images.len(),
            2,
            "only the image without depth is not kept"
        );
    }

    #[test]
    fn number_of_images_is_bounded() {
        let keyframes = capture(&Miscalibration::none());
        let mut detector = MovementDetector::new(&keyframes);
        for round in 0..3 {
            for keyframe in &keyframes {
                let later = Keyframe {
                    stamp: kinematics::Stamp(keyframe.stamp.0 + (round + 1) * 100_000_000_000),
                    ..keyframe.as_ref().clone()
                };
                assert_eq!(detector.push(&Arc::new(later)), None);
                assert!(detector.images.len() <= MAX_REFERENCES + MOVEMENT_WINDOW + 1);
                assert_eq!(detector.images.len(), detector.states.len());
            }
        }
        assert!(detector.references().len() >= MAX_REFERENCES / 2);
    }
}
