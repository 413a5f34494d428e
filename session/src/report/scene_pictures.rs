//! The pictures of the whole scene on the report page: the model from outside, and a map.

use super::coverage;
use super::overview;
use super::seen_places::SeenPlaces;
use keyframe::Keyframe;
use std::sync::Arc;
use trainer::AlignedModel;

/// Pictures of the scene; empty without keyframes.
#[derive(Default)]
pub(crate) struct ScenePictures {
    /// The model seen obliquely, as a data URI.
    overview: Option<String>,
    /// Map of the places that the keyframes show, as SVG, and the spacing of its grid in meters.
    coverage: Option<(String, f64)>,
    n_keyframes: usize,
}

impl ScenePictures {
    /// Renders the model, and draws the map of these keyframes.
    pub(crate) fn draw(
        method: &mut AlignedModel,
        keyframes: &[Arc<Keyframe>],
    ) -> anyhow::Result<Self> {
        let Some(seen) = SeenPlaces::of(method, keyframes)? else {
            return Ok(Self::default());
        };
        let n_pixels = |[width, height]: [u32; 2]| u64::from(width) * u64::from(height);
        let sizes = keyframes.iter().map(|keyframe| n_pixels(keyframe.size_px));
        let image_px = sizes.max().unwrap_or_default();
        Ok(Self {
            overview: overview::draw(method, &seen, image_px)?,
            coverage: coverage::map(&seen),
            n_keyframes: keyframes.len(),
        })
    }

    pub(super) fn html(&self) -> String {
        let [width, height] = overview::shown_size();
        let overview = self.overview.as_ref().map(|source| {
            format!(
                "<figure class=\"card\"><img width=\"{width}\" height=\"{height}\" alt=\"The model seen obliquely from above\" \
                 src=\"{source}\"><figcaption>The model, seen obliquely from above. What is between the viewer and the scene is \
                 cut away.</figcaption></figure>\n"
            )
        });
        let coverage = self.coverage.as_ref().map(|(svg, spacing_m)| {
            format!(
                "<figure class=\"card\">{svg}<figcaption>Where the {} looked, from above (x to the right, y up; the grid is \
                 {spacing_m} m): the darker, the more images show it. Dots are cameras, rings those of test \
                 images.</figcaption></figure>\n",
                messages::counted(self.n_keyframes as u64, "keyframe")
            )
        });
        let figures: String = overview.into_iter().chain(coverage).collect();
        if figures.is_empty() {
            return String::new();
        }
        format!("<h2>Scene</h2>\n<div class=\"scene\">\n{figures}</div>\n")
    }
}
