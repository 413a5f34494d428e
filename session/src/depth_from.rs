//! `--depth-from`: renders depth for images without depth from a saved model.

use crate::evaluate::{self, CHECK_SAME_SCENE, MIN_ALPHA, MIN_COVERED_FRAC};
use crate::read_progress::{OnReadProgress, ReadProgress};
use crate::{methods, run_folder};
use anyhow::Context;
use gpu::Gpu;
use keyframe::{DepthMap, Keyframe, Split};
use messages::{BadInput, InsufficientData, Setting, counted};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::{AlignedModel, Picture};

/// A saved model from which depth is rendered.
#[derive(Clone, Debug)]
pub struct DepthSource {
    model: PathBuf,
    /// SHA-256 of its files.
    pub sha256: String,
}

/// Result of rendering depth.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RenderedDepth {
    model: PathBuf,
    model_sha256: String,
    /// Number of images for which depth was rendered. Only images that lack depth in more than half
    /// of their pixels are eligible.
    pub n_images: usize,
    /// Fraction of the missing depth pixels of eligible images that were filled.
    rendered_frac: f64,
}

impl DepthSource {
    /// The model in a folder, or in a single file of splats.
    pub fn find(model: &Path) -> anyhow::Result<Self> {
        let invalid = |error: anyhow::Error| BadInput(format!("{}: {error:#}", Setting::DepthFrom));
        run_folder::expect_model(model).map_err(invalid)?;
        let sha256 = if model.is_file() {
            let bytes = files::read(model, files::Budget::PLAIN)
                .with_context(|| format!("cannot read {}", model.display()))?;
            run_folder::hex(&Sha256::digest(bytes))
        } else {
            run_folder::checkpoint_sha256(model)?
        };
        Ok(Self {
            model: model.to_owned(),
            sha256,
        })
    }

    /// Renders depth for training and validation keyframes that have no depth or only sparse depth.
    /// Measured depth is kept.
    pub fn draw(
        &self,
        gpu: Arc<Gpu>,
        keyframes: &mut [Arc<Keyframe>],
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<RenderedDepth> {
        let model_name = self.model.display();
        let mut model = methods::load(gpu, &self.model)
            .with_context(|| format!("{} {model_name}", Setting::DepthFrom))?
            .method;
        let mut totals = Filled::default();
        let mut n_images = 0;
        // Test images get no rendered depth: it is not a measurement, so depth scores against it
        // would be meaningless.
        let mut lacking: Vec<&mut Arc<Keyframe>> = keyframes
            .iter_mut()
            .filter(|keyframe| keyframe.split != Split::Test && keyframe.lacks_dense_depth())
            .collect();
        let n_all = Some(lacking.len());
        for (ix, keyframe) in lacking.iter_mut().enumerate() {
            let filled = fill(&mut model, keyframe)?;
            n_images += usize::from(filled.n_rendered > 0);
            totals = Filled {
                n_missing: totals.n_missing + filled.n_missing,
                n_rendered: totals.n_rendered + filled.n_rendered,
            };
            progress(ReadProgress {
                noun: "depth images",
                n_done: ix + 1,
                n_all,
            });
        }
        // The usual cause is a model of another scene, or in another world frame.
        if totals.n_missing > 0 && totals.n_rendered == 0 {
            let message = "the model is not visible in any image that lacks depth";
            return Err(InsufficientData(format!(
                "{} {model_name}: {message}; {CHECK_SAME_SCENE}",
                Setting::DepthFrom
            ))
            .into());
        }
        let rendered_frac = totals.n_rendered as f64 / totals.n_missing.max(1) as f64;
        let images = counted(n_images as u64, "image");
        let message = format!(
            "rendered depth for {images} from {model_name}: {:.1} % of the missing pixels",
            100.0 * rendered_frac
        );
        match (totals.n_missing, rendered_frac) {
            (0, _) => {
                log::warn!(
                    "{} {model_name} has no effect: no training image lacks depth",
                    Setting::DepthFrom
                );
            }
            (_, frac) if frac < MIN_COVERED_FRAC => log::warn!("{message}; {CHECK_SAME_SCENE}"),
            _ => log::info!("{message}"),
        }
        Ok(RenderedDepth {
            model: self.model.clone(),
            model_sha256: self.sha256.clone(),
            n_images,
            rendered_frac,
        })
    }
}

/// Returns an error unless the depth models used `before` and given `now` have the same SHA-256.
///
/// `subject`: name of the earlier result in messages.
pub fn check_same(subject: &str, before: Option<&str>, now: Option<&str>) -> anyhow::Result<()> {
    let setting = Setting::DepthFrom;
    let message = match (before, now) {
        (before, now) if before == now => return Ok(()),
        (None, _) => format!("{subject} was made without {setting}: remove the flag"),
        (Some(before), None) => format!(
            "{subject} used depth rendered from the model with the SHA-256 {before}: give that model with {setting}"
        ),
        (Some(before), Some(now)) => format!(
            "{subject} used depth rendered from the model with the SHA-256 {before}, but the model given with \
             {setting} has {now}"
        ),
    };
    Err(BadInput(message).into())
}

/// Pixel counts of one or several keyframes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Filled {
    n_missing: u64,
    n_rendered: u64,
}

/// Renders the missing depth of one keyframe at the resolution of its depth image, or of its color
/// image if it has no depth.
fn fill(model: &mut AlignedModel, keyframe: &mut Arc<Keyframe>) -> anyhow::Result<Filled> {
    // An image without depth gets an empty depth map with the lens and pose of its color image.
    let mut request_keyframe = keyframe.as_ref().clone();
    let depth = request_keyframe.depth.get_or_insert_with(|| DepthMap {
        size_px: keyframe.size_px,
        focal_px: keyframe.focal_px,
        principal_px: keyframe.principal_px,
        depth_m: vec![0.0; keyframe.size_px[0] as usize * keyframe.size_px[1] as usize].into(),
        world_from_camera: keyframe.world_from_camera,
    });
    let measured = depth.clone();
    let Some(rendered) = evaluate::render_depth(model, &request_keyframe, &measured)? else {
        return Ok(Filled::default());
    };
    let (depth_m, filled) = merge_depth(&measured.depth_m, &rendered);
    if filled.n_rendered > 0 {
        request_keyframe.depth = Some(DepthMap {
            depth_m: depth_m.into(),
            ..measured
        });
        *keyframe = Arc::new(request_keyframe);
    }
    Ok(filled)
}

/// Measured depth in meters. Pixels without measured depth get the rendered depth, or 0 if there is
/// no rendered depth either.
fn merge_depth(own_m: &[f32], rendered: &Picture) -> (Vec<f32>, Filled) {
    let is_known = |z: f32| z > 0.0 && z.is_finite();
    let mut filled = Filled::default();
    let pixels = own_m
        .iter()
        .zip(&rendered.depth_m)
        .zip(rendered.rgba_srgb.as_chunks::<4>().0);
    let depth_m = pixels.map(|((measured, rendered), [.., alpha])| {
        if is_known(*measured) {
            return *measured;
        }
        filled.n_missing += 1;
        // Nearly transparent pixels do not show the depth of a surface.
        if *alpha < MIN_ALPHA || !is_known(*rendered) {
            return 0.0;
        }
        filled.n_rendered += 1;
        *rendered
    });
    (depth_m.collect(), filled)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn measured_depth_is_kept_and_uncovered_pixels_stay_empty() {
        let own_m = [2.0, 0.0, f32::NAN, 0.0, 0.0, f32::INFINITY];
        let depth_m = vec![3.0, 3.0, 4.0, 5.0, f32::NAN, 0.0];
        let alphas = [255, 255, MIN_ALPHA, MIN_ALPHA - 1, 255, 255];
        let rgba_srgb = alphas.iter().flat_map(|alpha| [9, 9, 9, *alpha]).collect();
        let (depth_m, filled) = merge_depth(
            &own_m,
            &Picture {
                size_px: [6, 1],
                rgba_srgb,
                depth_m,
            },
        );
        assert_eq!(depth_m, [2.0, 3.0, 4.0, 0.0, 0.0, 0.0]);
        assert_eq!(
            filled,
            Filled {
                n_missing: 5,
                n_rendered: 2
            }
        );
    }

    #[test]
    fn different_depth_model_is_rejected() {
        let message =
            |before, now| check_same("the log", before, now).map_err(|error| error.to_string());
        assert_eq!(
            (message(None, None), message(Some("5ad1"), Some("5ad1"))),
            (Ok(()), Ok(()))
        );
        assert!(
            message(None, Some("5ad1")).is_err_and(|message| message.contains("remove the flag"))
        );
        assert!(
            message(Some("5ad1"), None)
                .is_err_and(|message| message.contains("5ad1: give that model with"))
        );
        let other = message(Some("5ad1"), Some("c0de"));
        assert!(other.is_err_and(|message| message.contains("5ad1") && message.contains("c0de")));
    }
}
