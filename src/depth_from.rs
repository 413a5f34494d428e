//! Depth for images that have none, drawn from a saved model where they were taken: `--depth-from`.

use crate::evaluate::{LEAST_ALPHA, LEAST_SEEN_FRAC, OTHER_PLACE};
use crate::exit::{BadArgument, LackOfEvidence};
use crate::{evaluate, method, print, run_folder};
use anyhow::Context;
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::gpu::Gpu;
use trainer::{DepthMap, Keyframe, Method, Picture, Split};

/// A saved model that depth is drawn from.
#[derive(Clone, Debug)]
pub(crate) struct DepthSource {
    model: PathBuf,
    /// Of its files.
    pub(crate) sha256: String,
}

/// How much depth was drawn.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct DrawnDepth {
    model: PathBuf,
    model_sha256: String,
    /// Images to learn from that got some: those with depth on less than half of their pixels.
    pub(crate) n_images: usize,
    /// Share of the pixels without depth of such images that got it.
    drawn_frac: f64,
}

impl DepthSource {
    /// The model in a folder, or in a file of splats.
    pub(crate) fn find(model: &Path) -> anyhow::Result<Self> {
        let wrong = |error: anyhow::Error| BadArgument(format!("--depth-from: {error:#}"));
        run_folder::expect_model(model).map_err(wrong)?;
        let sha256 = if model.is_file() {
            let bytes = std::fs::read(model).with_context(|| format!("cannot read {}", model.display()))?;
            run_folder::hex(&Sha256::digest(bytes))
        } else {
            run_folder::checkpoint_sha256(model)?
        };
        Ok(Self { model: model.to_owned(), sha256 })
    }

    /// Gives depth to all keyframes but those for testing where they have none, or next to none. What was measured stays.
    pub(crate) fn draw(
        &self,
        gpu: Arc<Gpu>,
        keyframes: &mut [Arc<Keyframe>],
        quiet: bool,
    ) -> anyhow::Result<DrawnDepth> {
        let place = self.model.display();
        let mut model = method::load(gpu, &self.model).with_context(|| format!("--depth-from {place}"))?;
        let bar = print::bar(Some(keyframes.len() as u64), "{bar:30} {pos} of {len} depth images", quiet);
        let mut sum = Filled::default();
        let mut n_images = 0;
        for keyframe in keyframes.iter_mut().filter(|keyframe| keyframe.split != Split::Test && keyframe.is_bare()) {
            let filled = fill(model.as_mut(), keyframe)?;
            n_images += usize::from(filled.n_drawn > 0);
            sum = Filled { n_missing: sum.n_missing + filled.n_missing, n_drawn: sum.n_drawn + filled.n_drawn };
            bar.inc(1);
        }
        bar.finish_and_clear();
        if sum.n_missing > 0 && sum.n_drawn == 0 {
            let told = "no image sees anything of that model where it lacks depth";
            return Err(LackOfEvidence(format!("--depth-from {place}: {told}; {OTHER_PLACE}")).into());
        }
        let drawn_frac = sum.n_drawn as f64 / sum.n_missing.max(1) as f64;
        let images = print::counted(n_images as u64, "image");
        let told = format!("depth of {images} was drawn from {place}: {:.1} % of what they lacked", 100.0 * drawn_frac);
        match (sum.n_missing, drawn_frac) {
            (0, _) => log::warn!("--depth-from {place}: no image to learn from lacks depth, so it changes nothing"),
            (_, frac) if frac < LEAST_SEEN_FRAC => log::warn!("{told}; {OTHER_PLACE}"),
            _ => log::info!("{told}"),
        }
        Ok(DrawnDepth { model: self.model.clone(), model_sha256: self.sha256.clone(), n_images, drawn_frac })
    }
}

/// Refuses a model that is not the one that depth was drawn from before; `before` and `now` are sums of them.
///
/// `whose`: what was made before.
pub(crate) fn check_same(whose: &str, before: Option<&str>, now: Option<&str>) -> Result<(), BadArgument> {
    match (before, now) {
        (before, now) if before == now => Ok(()),
        (None, _) => Err(BadArgument(format!("{whose} had no depth drawn from a model: leave out --depth-from"))),
        (Some(before), None) => Err(BadArgument(format!(
            "{whose} had depth drawn from the model with the SHA-256 {before}: name it with --depth-from"
        ))),
        (Some(before), Some(now)) => Err(BadArgument(format!(
            "{whose} had depth drawn from the model with the SHA-256 {before}, --depth-from names one with {now}"
        ))),
    }
}

/// Pixels of one keyframe, or of several.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Filled {
    n_missing: u64,
    n_drawn: u64,
}

/// Draws what one keyframe lacks: in its own depth image, else in one with the lens of its color image.
fn fill(model: &mut dyn Method, keyframe: &mut Arc<Keyframe>) -> anyhow::Result<Filled> {
    let mut asked = keyframe.as_ref().clone();
    let depth = asked.depth.get_or_insert_with(|| DepthMap {
        size_px: keyframe.size_px,
        focal_px: keyframe.focal_px,
        principal_px: keyframe.principal_px,
        depth_m: vec![0.0; keyframe.size_px[0] as usize * keyframe.size_px[1] as usize].into(),
        world_from_camera: keyframe.world_from_camera,
    });
    let own = depth.clone();
    let Some(drawn) = evaluate::draw_depth(model, &asked, &own)? else { return Ok(Filled::default()) };
    let (depth_m, filled) = both(&own.depth_m, &drawn);
    if filled.n_drawn > 0 {
        asked.depth = Some(DepthMap { depth_m: depth_m.into(), ..own });
        *keyframe = Arc::new(asked);
    }
    Ok(filled)
}

/// Depth as it was measured, metres, and as it was drawn where it was not; 0 where neither knows any.
fn both(own_m: &[f32], drawn: &Picture) -> (Vec<f32>, Filled) {
    let is_known = |z: f32| z > 0.0 && z.is_finite();
    let mut filled = Filled::default();
    let pixels = own_m.iter().zip(&drawn.depth_m).zip(drawn.rgba_srgb.as_chunks::<4>().0);
    let depth_m = pixels.map(|((own, drawn), [.., alpha])| {
        if is_known(*own) {
            return *own;
        }
        filled.n_missing += 1;
        if *alpha < LEAST_ALPHA || !is_known(*drawn) {
            return 0.0;
        }
        filled.n_drawn += 1;
        *drawn
    });
    (depth_m.collect(), filled)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_measured_stays_and_what_a_model_hardly_covers_is_nothing() {
        let own_m = [2.0, 0.0, f32::NAN, 0.0, 0.0, f32::INFINITY];
        let depth_m = vec![3.0, 3.0, 4.0, 5.0, f32::NAN, 0.0];
        let alphas = [255, 255, LEAST_ALPHA, LEAST_ALPHA - 1, 255, 255];
        let rgba_srgb = alphas.iter().flat_map(|alpha| [9, 9, 9, *alpha]).collect();
        let (depth_m, filled) = both(&own_m, &Picture { size_px: [6, 1], rgba_srgb, depth_m });
        assert_eq!(depth_m, [2.0, 3.0, 4.0, 0.0, 0.0, 0.0]);
        assert_eq!(filled, Filled { n_missing: 5, n_drawn: 2 });
    }

    #[test]
    fn another_model_is_refused_by_both_sums() {
        let told = |before, now| check_same("the log", before, now).map_err(|error| error.0);
        assert_eq!((told(None, None), told(Some("5ad1"), Some("5ad1"))), (Ok(()), Ok(())));
        assert!(told(None, Some("5ad1")).is_err_and(|told| told.contains("leave out --depth-from")));
        assert!(told(Some("5ad1"), None).is_err_and(|told| told.contains("5ad1: name it with --depth-from")));
        let other = told(Some("5ad1"), Some("c0de"));
        assert!(other.is_err_and(|told| told.contains("5ad1") && told.contains("c0de")));
    }
}
