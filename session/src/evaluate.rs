//! Evaluates a model: renders it at the pose and size of each test keyframe, and scores the
//! renders.
//!
//! `train`, `run` and `eval` all use this code, so they report the same scores for the same model.

use anyhow::Context;
use calibration::CalibratedCamera;
use keyframe::{DepthMap, Keyframe};
use kinematics::Transform;
use messages::counted;
use serde::Serialize;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt::{Display, Formatter};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use trainer::eval::{Lpips, PixelPair, depth_rmse_m, psnr, ssim, surface_error};
use trainer::{AlignedModel, Picture, Projection, RenderRequest};

/// Environment variable with the path of the LPIPS weights, used if the flag is not given.
const LPIPS_WEIGHTS: &str = "FIELDRIG_LPIPS_WEIGHTS";
/// Near plane of renders, meters. A gripper may be this close to its camera.
const NEAR_M: f64 = 0.01;
/// Far plane of renders, meters. Photos of a dataset may show a landscape.
const FAR_M: f64 = 1000.0;

/// How long [`Evaluator::score_all`] waits for scores before it calls `meanwhile` again.
/// `meanwhile` draws pictures for viewers, so a longer wait would delay these pictures.
const MEANWHILE_PERIOD: Duration = Duration::from_millis(5);

/// Maximum length of the list of cameras in [`Scores::short`]. Lines with it fit into 110 columns.
const MAX_CAMERAS_CHARS: usize = 32;

/// Minimum alpha of a pixel that counts as covered by the model: half of the range. Below it, the
/// background contributes more to the color than the model.
pub const MIN_ALPHA: u8 = 128;
/// Minimum covered fraction. Below it, model and images probably show different scenes. It only
/// causes a warning, because a small object may also cover such a small fraction.
pub const MIN_COVERED_FRAC: f64 = 0.05;
/// Hint to print if the covered fraction is below [`MIN_COVERED_FRAC`].
pub const CHECK_SAME_SCENE: &str =
    "check that model and camera poses belong to the same scene and world frame";

/// Loads LPIPS if the flag or `FIELDRIG_LPIPS_WEIGHTS` gives weights. A program built without LPIPS
/// logs a warning.
pub fn load_lpips(flag: Option<&Path>) -> Result<Option<Lpips>, trainer::Error> {
    let named = std::env::var_os(LPIPS_WEIGHTS).map(PathBuf::from);
    let Some(weights) = flag.or(named.as_deref()) else {
        return Ok(None);
    };
    match Lpips::load(weights) {
        Err(error @ trainer::Error::LpipsNotBuilt) => {
            log::warn!("no LPIPS: {error}");
            Ok(None)
        }
        lpips => lpips.map(Some),
    }
}

/// Computes scores of test images.
#[derive(Clone)]
pub struct Evaluator {
    /// Whether to compute all available scores rather than PSNR only.
    is_full: bool,
    /// `None` without weights.
    lpips: Option<Arc<Lpips>>,
}

/// Scores of one test image. `None` means unknown, never zero.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ImageScores {
    /// Name of the camera.
    pub camera: String,
    /// Stamp of the image, nanoseconds.
    pub stamp_nanos: i64,
    /// PSNR against the image as the camera delivered it, dB.
    pub psnr: f64,
    /// Structural similarity, up to 1.
    pub ssim: Option<f64>,
    /// Perceptual distance; `None` without weights.
    pub lpips: Option<f64>,
    /// Root mean square error along z over pixels with rendered and measured depth, meters.
    pub depth_rmse_m: Option<f64>,
    /// Accuracy: mean distance of the rendered surface from the measured surface along the measured
    /// normal, meters.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub surface_error_m: Option<f64>,
    /// Completeness: fraction of the measured surface that is rendered within 5 mm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub surface_within_5_mm: Option<f64>,
    /// PSNR of a render at the true pose against the noise-free image, dB; in simulation only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_truth: Option<f64>,
    /// PSNR of the delivered image against the noise-free image, dB; in simulation only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_ceiling: Option<f64>,
    /// Fraction of pixels that the model covers; `None` if the render was scored on the GPU.
    #[serde(skip)]
    pub covered_frac: Option<f64>,
}

/// Mean scores over the test images. `None` means unknown, never zero.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Scores {
    /// See [`ImageScores::psnr`].
    pub psnr: Option<f64>,
    /// See [`ImageScores::ssim`].
    pub ssim: Option<f64>,
    /// See [`ImageScores::lpips`].
    pub lpips: Option<f64>,
    /// See [`ImageScores::depth_rmse_m`].
    pub depth_rmse_m: Option<f64>,
    /// See [`ImageScores::surface_error_m`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub surface_error_m: Option<f64>,
    /// See [`ImageScores::surface_within_5_mm`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub surface_within_5_mm: Option<f64>,
    /// See [`ImageScores::psnr_truth`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_truth: Option<f64>,
    /// See [`ImageScores::psnr_ceiling`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_ceiling: Option<f64>,
    /// PSNR per camera; empty if there is only one camera.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub psnr_per_camera: BTreeMap<String, f64>,
}

impl Evaluator {
    /// Computes PSNR, SSIM, depth scores and, if the flag or `FIELDRIG_LPIPS_WEIGHTS` gives
    /// weights, LPIPS.
    pub fn thorough(lpips_weights: Option<&Path>) -> anyhow::Result<Self> {
        Ok(Self {
            is_full: true,
            lpips: load_lpips(lpips_weights)?.map(Arc::new),
        })
    }

    /// Returns this evaluator without LPIPS, which takes seconds per image.
    #[must_use]
    pub fn without_lpips(&self) -> Self {
        Self {
            lpips: None,
            ..self.clone()
        }
    }

    /// Computes PSNR only, with one render per image.
    pub fn psnr_only() -> Self {
        Self {
            is_full: false,
            lpips: None,
        }
    }

    /// Scores one test keyframe.
    pub fn score(
        &self,
        method: &mut AlignedModel,
        keyframe: &Keyframe,
    ) -> anyhow::Result<ImageScores> {
        let remasked = method.remasked(keyframe);
        // Scoring on the GPU needs no read-back of the picture. Other scores need the pixels.
        if !self.is_full
            && self.lpips.is_none()
            && let Some(psnr) = psnr_on_gpu(method, &remasked)?
        {
            return Ok(ImageScores {
                camera: keyframe.camera.to_string(),
                stamp_nanos: keyframe.stamp.0,
                psnr,
                ssim: None,
                lpips: None,
                depth_rmse_m: None,
                surface_error_m: None,
                surface_within_5_mm: None,
                psnr_truth: None,
                psnr_ceiling: keyframe.truth.as_ref().and_then(|truth| truth.psnr_ceiling),
                covered_frac: None,
            });
        }
        self.draw(method, keyframe)?.scores(self)
    }

    /// Scores one test keyframe. Errors name the keyframe.
    pub fn score_named(
        &self,
        method: &mut AlignedModel,
        keyframe: &Keyframe,
    ) -> anyhow::Result<ImageScores> {
        self.score(method, keyframe)
            .with_context(|| name_of(keyframe))
    }

    /// Scores test keyframes: while some are scored on the CPU, the next ones are rendered. The
    /// result has the order of `tests`.
    ///
    /// * `meanwhile`: called often with the number of scored keyframes, even if there is nothing to
    ///   render.
    pub fn score_all<'a>(
        &self,
        method: &mut AlignedModel,
        tests: impl Iterator<Item = &'a Arc<Keyframe>>,
        mut meanwhile: impl FnMut(&mut AlignedModel, usize),
    ) -> anyhow::Result<Vec<ImageScores>> {
        // Each thread has two pictures: one that it scores, and one that waits. More pictures would
        // only use more memory.
        let max_waiting = 2 * rayon::current_num_threads();
        let (sender, receiver) = std::sync::mpsc::sync_channel(max_waiting);
        let mut scored: Vec<(usize, ImageScores)> = Vec::new();
        // The scope runs in place, because the method cannot be sent to another thread.
        let all: anyhow::Result<()> = rayon::in_place_scope(|scope| {
            let mut n_drawn = 0;
            // The iterator is fused, because the loop calls `next` again after the last image.
            let mut tests = tests.fuse();
            loop {
                let next = if n_drawn - scored.len() < max_waiting {
                    tests.next()
                } else {
                    None
                };
                if let Some(keyframe) = next {
                    let drawn = self
                        .draw(method, keyframe)
                        .with_context(|| name_of(keyframe))?;
                    let ix = n_drawn;
                    let sender = sender.clone();
                    scope.spawn(move |_| {
                        // A panic is sent, too. Otherwise, the loop would wait for this result
                        // without end.
                        let scores = catch_unwind(AssertUnwindSafe(|| drawn.scores(self)));
                        // After an error of another keyframe, this result is not used.
                        let _ = sender.send((ix, keyframe, scores));
                    });
                    n_drawn += 1;
                } else if scored.len() == n_drawn {
                    return Ok(());
                }
                // While there is something to draw, results are only collected.
                let wait = if next.is_some() {
                    Duration::ZERO
                } else {
                    MEANWHILE_PERIOD
                };
                if let Ok((ix, keyframe, scores)) = receiver.recv_timeout(wait) {
                    let scores = scores.unwrap_or_else(|panic| resume_unwind(panic));
                    scored.push((ix, scores.with_context(|| name_of(keyframe))?));
                }
                meanwhile(method, scored.len());
            }
        });
        all?;
        // The threads finish in any order. The scores are sorted, so that means do not depend on
        // timing.
        scored.sort_by_key(|(ix, _)| *ix);
        Ok(scored.into_iter().map(|(_, scores)| scores).collect())
    }

    /// Renders the pictures from which the scores of a keyframe are computed.
    fn draw<'a>(
        &self,
        method: &mut AlignedModel,
        keyframe: &'a Keyframe,
    ) -> anyhow::Result<Drawn<'a>> {
        let keyframe = method.remasked(keyframe);
        if !self.is_full {
            return Ok(Drawn {
                picture: Arc::new(draw(method, &keyframe, false)?),
                keyframe,
                depth: None,
                at_truth: None,
            });
        }
        let lens = method.calibrated_camera(&keyframe)?;
        let depth = comparable_depth(method, &keyframe);
        // If the depth image has the same viewing rays as the color image, one picture gives both.
        let is_aligned = depth
            .as_ref()
            .is_some_and(|depth| is_aligned(depth, &lens, &keyframe));
        let picture = Arc::new(draw(method, &keyframe, is_aligned)?);
        let depth = match depth {
            Some(depth) if is_aligned => Some((Arc::clone(&picture), depth)),
            Some(depth) => {
                render_depth(method, &keyframe, &depth)?.map(|drawn| (Arc::new(drawn), depth))
            }
            None => None,
        };
        Ok(Drawn {
            picture,
            depth,
            at_truth: draw_at_truth(method, &keyframe)?,
            keyframe,
        })
    }
}

fn name_of(keyframe: &Keyframe) -> String {
    format!(
        "test image of {:?} at {} ns",
        keyframe.camera, keyframe.stamp.0
    )
}

/// The renders from which the scores of a test keyframe are computed.
struct Drawn<'a> {
    /// The keyframe, with the mask of the robot as the corrected camera sees it.
    keyframe: Cow<'a, Keyframe>,
    picture: Arc<Picture>,
    /// Rendered depth, and the measured depth at its size.
    depth: Option<(Arc<Picture>, DepthMap)>,
    /// A render at the true pose.
    at_truth: Option<Picture>,
}

impl Drawn<'_> {
    /// Computes the scores, without the GPU.
    fn scores(&self, evaluator: &Evaluator) -> anyhow::Result<ImageScores> {
        let Self {
            keyframe,
            picture,
            depth,
            at_truth,
        } = self;
        let pair = PixelPair::new(keyframe.size_px, &picture.rgba_srgb, &keyframe.rgba_srgb)?;
        let rmse_m = depth
            .as_ref()
            .map(|(drawn, depth)| depth_rmse_m(&drawn.depth_m, &depth.depth_m));
        let surface = depth
            .as_ref()
            .map(|(drawn, depth)| surface_error(&drawn.depth_m, depth))
            .transpose()?
            .flatten();
        let truth = keyframe.truth.as_ref();
        let psnr_truth = at_truth.as_ref().zip(truth).map(|(drawn, truth)| {
            psnr(&PixelPair::new(
                keyframe.size_px,
                &drawn.rgba_srgb,
                &truth.rgba_srgb,
            )?)
        });
        Ok(ImageScores {
            camera: keyframe.camera.to_string(),
            stamp_nanos: keyframe.stamp.0,
            psnr: psnr(&pair)?,
            ssim: evaluator.is_full.then(|| ssim(&pair)).transpose()?,
            lpips: evaluator
                .lpips
                .as_ref()
                .map(|lpips| lpips.distance(&pair))
                .transpose()?,
            depth_rmse_m: rmse_m.transpose()?.flatten(),
            surface_error_m: surface.and_then(|surface| surface.mean_m),
            surface_within_5_mm: surface.map(|surface| surface.near_frac),
            psnr_truth: psnr_truth.transpose()?,
            psnr_ceiling: truth.and_then(|truth| truth.psnr_ceiling),
            covered_frac: Some(covered_frac(picture)),
        })
    }
}

impl Scores {
    /// The means over `images`.
    pub fn mean(images: &[ImageScores]) -> Self {
        let mut psnr_per_camera = BTreeMap::new();
        for image in images {
            psnr_per_camera
                .entry(image.camera.clone())
                .or_insert_with(Vec::new)
                .push(image.psnr);
        }
        // The PSNR of a single camera is the overall one.
        if psnr_per_camera.len() < 2 {
            psnr_per_camera.clear();
        }
        Self {
            psnr: mean(images.iter().map(|image| Some(image.psnr))),
            ssim: mean(images.iter().map(|image| image.ssim)),
            lpips: mean(images.iter().map(|image| image.lpips)),
            depth_rmse_m: mean(images.iter().map(|image| image.depth_rmse_m)),
            surface_error_m: mean(images.iter().map(|image| image.surface_error_m)),
            surface_within_5_mm: mean(images.iter().map(|image| image.surface_within_5_mm)),
            psnr_truth: mean(images.iter().map(|image| image.psnr_truth)),
            psnr_ceiling: mean(images.iter().map(|image| image.psnr_ceiling)),
            psnr_per_camera: psnr_per_camera
                .into_iter()
                .filter_map(|(camera, values)| Some((camera, mean(values.into_iter().map(Some))?)))
                .collect(),
        }
    }
}

impl Scores {
    /// The PSNR in a few words, for lines that are printed during training. If there are only a few
    /// cameras, the text includes the PSNR of each.
    #[must_use]
    pub fn short(&self) -> String {
        let Some(psnr) = self.psnr else {
            return "no test image yet".to_owned();
        };
        let cameras: Vec<String> = self
            .psnr_per_camera
            .iter()
            .map(|(camera, psnr)| format!("{camera} {psnr:.1}"))
            .collect();
        let cameras = cameras.join(", ");
        if cameras.is_empty() || cameras.len() > MAX_CAMERAS_CHARS {
            format!("PSNR {psnr:.2} dB")
        } else {
            format!("PSNR {psnr:.2} dB ({cameras})")
        }
    }
}

impl Display for Scores {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let decibels =
            |what: &str, value: Option<f64>| value.map(|value| format!("{what} {value:.2} dB"));
        let mut words: Vec<String> = decibels("PSNR", self.psnr).into_iter().collect();
        words.extend(
            self.psnr_per_camera
                .iter()
                .filter_map(|(camera, psnr)| decibels(camera, Some(*psnr))),
        );
        words.extend(decibels("against truth", self.psnr_truth));
        words.extend(decibels("noise limit", self.psnr_ceiling));
        words.extend(self.ssim.map(|ssim| format!("SSIM {ssim:.4}")));
        words.extend(self.lpips.map(|lpips| format!("LPIPS {lpips:.4}")));
        words.extend(
            self.depth_rmse_m
                .map(|depth| format!("depth {:.1} mm", depth * 1e3)),
        );
        words.extend(
            self.surface_error_m
                .map(|error| format!("surface {:.1} mm", error * 1e3)),
        );
        words.extend(
            self.surface_within_5_mm
                .map(|share| format!("{:.1} % within 5 mm", share * 1e2)),
        );
        if words.is_empty() {
            f.write_str("no test image yet")
        } else {
            f.write_str(&words.join(", "))
        }
    }
}

/// Fraction of a picture's pixels that the model covers.
pub fn covered_frac(picture: &Picture) -> f64 {
    let pixels = picture.rgba_srgb.as_chunks::<4>().0;
    let n_covered = pixels
        .iter()
        .filter(|[.., alpha]| *alpha >= MIN_ALPHA)
        .count();
    n_covered as f64 / pixels.len().max(1) as f64
}

/// Logs a warning if a model covers almost nothing of several pictures, given the covered fraction
/// of each.
pub fn warn_if_hardly_covered(covered_fracs: &[f64]) {
    let covered_frac = covered_fracs.iter().sum::<f64>() / covered_fracs.len().max(1) as f64;
    if covered_frac < MIN_COVERED_FRAC {
        let views = counted(covered_fracs.len() as u64, "view");
        log::warn!(
            "the model covers {:.1} % of {views}; {CHECK_SAME_SCENE}",
            100.0 * covered_frac
        );
    }
}

/// Mean of the known values.
fn mean(values: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    let mut sum = 0.0;
    let mut n = 0.0;
    for value in values.flatten() {
        sum += value;
        n += 1.0;
    }
    (n > 0.0).then(|| sum / n)
}

/// Renders a model at the pose of a keyframe, with the model's background and the keyframe's
/// rolling shutter and color gains.
pub fn draw(
    method: &mut AlignedModel,
    keyframe: &Keyframe,
    depth: bool,
) -> Result<Picture, trainer::Error> {
    let lens = method.calibrated_camera(keyframe)?;
    let background_srgb = method.model().background_srgb();
    let mut picture = method.model_mut().render(&RenderRequest {
        depth,
        background_srgb,
        ..request(keyframe, &lens)
    })?;
    // Images of a camera with automatic exposure are compared at their own brightness.
    if lens.gains != [1.0; 3] {
        let by_byte = lens.gains.map(gain_table);
        for [red, green, blue, _] in picture.rgba_srgb.as_chunks_mut::<4>().0 {
            for (color, table) in [red, green, blue].into_iter().zip(&by_byte) {
                *color = table[usize::from(*color)];
            }
        }
    }
    Ok(picture)
}

/// Computes the PSNR of [`draw`]'s picture on the GPU, bit-identical to the PSNR of the picture on
/// the host. `None` if the method does not support this, or if gains are applied after rendering.
fn psnr_on_gpu(
    method: &mut AlignedModel,
    keyframe: &Keyframe,
) -> Result<Option<f64>, trainer::Error> {
    let lens = method.calibrated_camera(keyframe)?;
    if lens.gains != [1.0; 3] {
        return Ok(None);
    }
    let background_srgb = method.model().background_srgb();
    method.model_mut().psnr(
        &RenderRequest {
            background_srgb,
            ..request(keyframe, &lens)
        },
        keyframe,
    )
}

/// Renders a model at the pose of a keyframe's depth image. Size and intrinsics come from `depth`,
/// which may be a subsampled depth map. `None` for a keyframe without depth.
pub fn render_depth(
    method: &mut AlignedModel,
    keyframe: &Keyframe,
    depth: &DepthMap,
) -> Result<Option<Picture>, trainer::Error> {
    let lens = method.calibrated_camera(keyframe)?;
    let Some(color_from_depth) = lens.color_from_depth else {
        return Ok(None);
    };
    // Depth is rendered from the pose of the depth camera. From the pose of the color camera, near
    // objects would hide other parts of the scene.
    let drawn = method.model_mut().render(&RenderRequest {
        world_from_camera: lens.world_from_camera * color_from_depth,
        size_px: depth.size_px,
        projection: Projection::Pinhole {
            focal_px: depth.focal_px,
            principal_px: depth.principal_px,
        },
        shutter: None,
        depth: true,
        ..request(keyframe, &lens)
    })?;
    Ok(Some(drawn))
}

/// Lookup table for multiplying a color value by `gain`.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to a byte"
)]
fn gain_table(gain: f64) -> [u8; 256] {
    std::array::from_fn(|value| (gain * value as f64).round().clamp(0.0, 255.0) as u8)
}

fn request(keyframe: &Keyframe, lens: &CalibratedCamera) -> RenderRequest {
    RenderRequest {
        world_from_camera: lens.world_from_camera,
        size_px: keyframe.size_px,
        projection: Projection::Pinhole {
            focal_px: lens.focal_px,
            principal_px: lens.principal_px,
        },
        shutter: lens.shutter,
        near_m: NEAR_M,
        far_m: FAR_M,
        crop: None,
        edits: Arc::default(),
        background_srgb: [0.0; 3],
        appearance_of: Some((keyframe.camera.clone(), keyframe.stamp)),
        depth: false,
    }
}

/// The measured depth at the size at which the method can be compared with it.
fn comparable_depth(method: &AlignedModel, keyframe: &Keyframe) -> Option<DepthMap> {
    let full = keyframe.depth.as_ref()?;
    let stride = method.model().depth_stride();
    Some(if stride > 1 {
        full.subsampled(stride)
    } else {
        full.clone()
    })
}

/// Whether each pixel of a depth image has the same viewing ray as the pixel of the color image, as
/// [`render_depth`] and [`draw`] render them.
fn is_aligned(depth: &DepthMap, lens: &CalibratedCamera, keyframe: &Keyframe) -> bool {
    lens.color_from_depth == Some(Transform::identity())
        && lens.shutter.is_none()
        && depth.size_px == keyframe.size_px
        && depth.focal_px == lens.focal_px
        && depth.principal_px == lens.principal_px
}

/// Renders at the true pose, for the comparison with the noise-free image, which has no rolling
/// shutter.
fn draw_at_truth(
    method: &mut AlignedModel,
    keyframe: &Keyframe,
) -> anyhow::Result<Option<Picture>> {
    let Some(truth) = &keyframe.truth else {
        return Ok(None);
    };
    let lens = CalibratedCamera {
        world_from_camera: truth.world_from_camera,
        ..method.calibrated_camera(keyframe)?
    };
    let background_srgb = method.model().background_srgb();
    Ok(Some(method.model_mut().render(&RenderRequest {
        shutter: None,
        background_srgb,
        ..request(keyframe, &lens)
    })?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(camera: &str, psnr: f64, lpips: Option<f64>) -> ImageScores {
        ImageScores {
            camera: camera.into(),
            stamp_nanos: 0,
            psnr,
            ssim: None,
            lpips,
            depth_rmse_m: None,
            surface_error_m: None,
            surface_within_5_mm: None,
            psnr_truth: None,
            psnr_ceiling: None,
            covered_frac: Some(1.0),
        }
    }

    #[test]
    fn short_scores_name_few_cameras() {
        let scores = |cameras: &[&str]| {
            let images: Vec<_> = cameras
                .iter()
                .zip([18.04, 20.0, 22.0, 24.0])
                .map(|(camera, psnr)| image(camera, psnr, None))
                .collect();
            Scores::mean(&images).short()
        };
        assert_eq!(scores(&[]), "no test image yet");
        assert_eq!(scores(&["wrist"]), "PSNR 18.04 dB");
        assert_eq!(
            scores(&["front", "rear"]),
            "PSNR 19.02 dB (front 18.0, rear 20.0)"
        );
        let long = ["front_left_camera", "front_right_camera", "rear_camera"];
        assert_eq!(scores(&long), "PSNR 20.01 dB");
    }

    #[test]
    fn pixels_count_as_covered_from_half_alpha() {
        let rgba_srgb = [0, MIN_ALPHA - 1, MIN_ALPHA, 255]
            .into_iter()
            .flat_map(|alpha| [9, 9, 9, alpha])
            .collect();
        assert_eq!(
            covered_frac(&Picture {
                size_px: [2, 2],
                rgba_srgb,
                depth_m: vec![0.0; 4]
            }),
            0.5
        );
    }

    #[test]
    fn means_skip_unknown_scores() {
        let scores = Scores::mean(&[image("wrist", 20.0, Some(0.5)), image("wrist", 30.0, None)]);
        assert_eq!(
            (scores.psnr, scores.lpips, scores.ssim),
            (Some(25.0), Some(0.5), None)
        );
        assert!(
            scores.psnr_per_camera.is_empty(),
            "a single camera is not reported separately"
        );
        assert_eq!(Scores::mean(&[]), Scores::default());
    }

    #[test]
    fn psnr_is_reported_per_camera() {
        let scores = Scores::mean(&[
            image("wrist", 20.0, None),
            image("front", 30.0, None),
            image("wrist", 22.0, None),
        ]);
        assert_eq!(scores.psnr, Some(24.0));
        assert_eq!(
            scores.psnr_per_camera,
            BTreeMap::from([("front".into(), 30.0), ("wrist".into(), 21.0)])
        );
    }
}
