//! The extent of a scene that grows during a run, as it is sent to viewers.

use crate::scene_hint::{SceneView, radius_m, union};
use keyframe::Keyframe;
use std::sync::Arc;
use viz::{Hub, SceneBounds};

/// The extent is sent again when its radius has grown by this factor. Viewers that have not moved
/// their view follow the extent. With a smaller factor, their view would move more often, and each
/// time they would wait for a picture.
const MIN_GROWTH: f64 = 1.2;

/// The extent that viewers have.
#[derive(Default)]
pub(super) struct GrowingScene {
    /// The published extent and view. Later extents keep the view of the first keyframe, because
    /// this keyframe may be evicted later.
    published: Option<SceneView>,
}

impl GrowingScene {
    /// Publishes the extent of these keyframes if none was published before, or if it has grown
    /// noticeably.
    pub(super) fn publish(&mut self, keyframes: &[Arc<Keyframe>], hub: &Hub) {
        let Some(mut view) = SceneView::from_keyframes(keyframes) else {
            return;
        };
        if let Some(published) = &self.published {
            if !has_grown(&published.bounds, &view.bounds) {
                return;
            }
            view.world_from_camera = published.world_from_camera;
        }
        view.publish(hub);
        self.published = Some(view);
    }
}

/// Whether the new bounds reach far beyond the published ones.
fn has_grown(published: &SceneBounds, new: &SceneBounds) -> bool {
    radius_m(&union(published, new)) > MIN_GROWTH * radius_m(published)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(side_m: f64, x_m: f64) -> SceneBounds {
        SceneBounds {
            min_m: [x_m, 0.0, 0.0],
            max_m: [x_m + side_m, side_m, side_m],
        }
    }

    #[test]
    fn bounds_are_sent_again_only_after_they_have_grown_noticeably() {
        let published = cube(1.0, 0.0);
        assert!(!has_grown(&published, &published));
        assert!(!has_grown(&published, &cube(1.15, 0.0)));
        assert!(has_grown(&published, &cube(1.25, 0.0)));
        // The scene has moved on, for example with a mobile base.
        assert!(has_grown(&published, &cube(1.0, 1.0)));
        // A scene does not grow when keyframes no longer show a part of it.
        assert!(!has_grown(&published, &cube(0.5, 0.0)));
    }
}
