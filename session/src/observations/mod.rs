//! Publishes when and how precisely each part of the scene was observed, while a client shows it.

mod map;

use background::Task;
use keyframe::{DepthMap, Keyframe};
use kinematics::{Stamp, Transform, transform};
use map::PosedDepth;
use model_files::Edits;
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{Picture, Projection, RenderRequest};
use viz::{Hub, KeyframePose};

/// Maximum width of the depth maps. A cell of the map then meets several rays of most keyframes.
/// The time for rendering and for the map grows with the square of the width.
const MAX_WIDTH_PX: u32 = 96;
/// Minimum time between two checks: the time for rendering per check, divided by its allowed
/// fraction.
const CHECK_PERIOD: Duration = Duration::from_millis(50);
/// Minimum time between two maps. Each one is computed and sent as a whole.
const MAP_PERIOD: Duration = Duration::from_secs(1);
/// Time for rendering depth per check, unless a single picture takes longer. Training waits for
/// this time.
const RENDER_TIME: Duration = Duration::from_millis(5);
/// Maximum fraction of the time for rendering, which training would otherwise use.
const MAX_RENDER_FRAC: f64 = 0.1;
/// Maximum fraction of one processor for maps.
const MAX_MAP_FRAC: f64 = 0.1;
/// Depth is rendered again after this factor of training steps. A model changes less and less, so
/// the intervals grow with the number of steps. A smaller factor follows the model more closely,
/// and renders more often.
const STEP_FACTOR: f64 = 1.5;

/// Camera and stamp of a keyframe.
type Key = (Arc<str>, Stamp);

/// A keyframe whose camera has observed the scene.
#[derive(Clone, Debug)]
pub(crate) struct PosedKeyframe {
    /// Pose and intrinsics, with corrections.
    pub(crate) pose: KeyframePose,
    /// The keyframe, if it is available. If it has depth, no depth is rendered.
    pub(crate) keyframe: Option<Arc<Keyframe>>,
    /// Pose of its depth camera in the frame of its color camera, with corrections; the identity
    /// without depth. Corrections of the focal lengths and of the scale of depth are not applied to
    /// it.
    pub(crate) color_from_depth: Transform,
}

/// What the map depends on besides the keyframes.
pub(crate) struct ModelState<'a> {
    /// Training step.
    pub(crate) step: u64,
    /// Its edits.
    pub(crate) edits: &'a Arc<Edits>,
    /// When a keyframe was captured; `None` if another process captured it.
    pub(crate) captured_at: &'a dyn Fn(&KeyframePose) -> Option<Instant>,
}

/// Depth of a keyframe at a low resolution.
#[derive(Clone, Debug)]
struct KnownDepth {
    /// The depth map; its pose is not used, because corrections change it.
    depth: DepthMap,
    /// Training step at which it was rendered; `None` if it was measured.
    rendered_at: Option<u64>,
}

/// Computes the map on another thread.
pub(crate) struct ObservationPublisher {
    hub: Hub,
    depths: BTreeMap<Key, KnownDepth>,
    /// Edits with which the depth was rendered.
    edits: Arc<Edits>,
    /// Whether a depth has changed since the last map.
    is_changed: bool,
    /// Poses of the depth in the last map.
    mapped: BTreeMap<Key, Transform>,
    task: Option<(Instant, Task<()>)>,
    next_check: Instant,
    next_map: Instant,
}

impl ObservationPublisher {
    /// A publisher for the clients of a hub.
    pub(crate) fn new(hub: Hub) -> Self {
        let now = Instant::now();
        Self {
            hub,
            depths: BTreeMap::new(),
            edits: Arc::default(),
            is_changed: false,
            mapped: BTreeMap::new(),
            task: None,
            next_check: now,
            next_map: now,
        }
    }

    /// Whether [`Self::publish`] should be called. Frees all memory while no client shows the map.
    pub(crate) fn is_due(&mut self) -> bool {
        if !self.hub.needs_observations() {
            if !self.mapped.is_empty() || !self.depths.is_empty() {
                *self = Self::new(self.hub.clone());
            }
            return false;
        }
        Instant::now() >= self.next_check
    }

    /// Renders missing depth of the keyframes with `render`, a few per call, and starts to compute
    /// the map if it has changed. Returns the time spent.
    pub(crate) fn publish(
        &mut self,
        keyframes: &[PosedKeyframe],
        model: &ModelState<'_>,
        render: impl FnMut(&RenderRequest) -> Result<Picture, trainer::Error>,
    ) -> Duration {
        let began = Instant::now();
        if !Arc::ptr_eq(&self.edits, model.edits) {
            // Surfaces may have become visible.
            self.edits = Arc::clone(model.edits);
            self.depths.retain(|_, known| known.rendered_at.is_none());
        }
        // Depth of evicted keyframes is removed, so that memory stays bounded.
        let keys: BTreeSet<Key> = keyframes.iter().map(PosedKeyframe::key).collect();
        let n_before = self.depths.len();
        self.depths.retain(|key, _| keys.contains(key));
        self.is_changed |= self.depths.len() < n_before;
        self.add_measured(keyframes);
        self.render_depths(keyframes, model.step, render);
        self.start_map(keyframes, model.captured_at);
        let spent = began.elapsed();
        // A single picture may take longer than `RENDER_TIME`, on a CPU for example. The pause
        // after it keeps the fraction of the time.
        self.next_check = Instant::now() + CHECK_PERIOD.max(spent.div_f64(MAX_RENDER_FRAC));
        spent
    }

    fn add_measured(&mut self, keyframes: &[PosedKeyframe]) {
        for keyframe in keyframes {
            let Some(depth) = keyframe
                .keyframe
                .as_ref()
                .and_then(|keyframe| keyframe.depth.as_ref())
            else {
                continue;
            };
            let Entry::Vacant(entry) = self.depths.entry(keyframe.key()) else {
                continue;
            };
            // The stride is odd, so that each remaining pixel is the center of the block that it
            // represents.
            let stride = depth.size_px[0].div_ceil(MAX_WIDTH_PX) | 1;
            entry.insert(KnownDepth {
                depth: depth.subsampled(stride),
                rendered_at: None,
            });
            self.is_changed = true;
        }
    }

    /// Renders depth for the newest keyframes that have none, and then for those whose depth is
    /// oldest.
    fn render_depths(
        &mut self,
        keyframes: &[PosedKeyframe],
        step: u64,
        mut render: impl FnMut(&RenderRequest) -> Result<Picture, trainer::Error>,
    ) {
        let rendered_at = |keyframe: &PosedKeyframe| self.depths.get(&keyframe.key())?.rendered_at;
        let mut due: Vec<_> = keyframes
            .iter()
            .filter(|keyframe| {
                self.depths
                    .get(&keyframe.key())
                    .is_none_or(|known| known.is_outdated(step))
            })
            .collect();
        // Keyframes without depth come first, because `None` is less than any step. Among the
        // keyframes without depth, the newest ones come first, because they matter most to an
        // operator.
        due.sort_by_key(|keyframe| {
            (
                rendered_at(keyframe),
                std::cmp::Reverse(keyframe.pose.stamp.0),
            )
        });
        let began = Instant::now();
        for keyframe in due {
            let request = depth_request(&keyframe.pose, &self.edits);
            let depth = match render(&request) {
                Ok(picture) => depth_map(&request, picture),
                Err(error) => {
                    // A lost device is detected by training, too.
                    log::debug!("no depth for the map of observations: {error}");
                    return;
                }
            };
            self.depths.insert(
                keyframe.key(),
                KnownDepth {
                    depth,
                    rendered_at: Some(step),
                },
            );
            self.is_changed = true;
            // The remaining keyframes follow with the next checks.
            if began.elapsed() >= RENDER_TIME {
                return;
            }
        }
    }

    /// Starts to compute the map if it has changed and the last one is complete.
    fn start_map(
        &mut self,
        keyframes: &[PosedKeyframe],
        captured_at: &dyn Fn(&KeyframePose) -> Option<Instant>,
    ) {
        if let Some((began, _)) = self.task.take_if(|(_, thread)| thread.is_finished()) {
            self.next_map = began + MAP_PERIOD.max(began.elapsed().div_f64(MAX_MAP_FRAC));
        }
        if self.task.is_some() || Instant::now() < self.next_map {
            return;
        }
        if !self.is_changed && !keyframes.iter().any(|keyframe| self.has_moved(keyframe)) {
            return;
        }
        let known = keyframes
            .iter()
            .filter_map(|keyframe| Some((keyframe, self.depths.get(&keyframe.key())?)));
        let observed: Vec<_> = known
            .clone()
            .map(|(keyframe, known)| known.posed(keyframe))
            .collect();
        self.mapped = known
            .clone()
            .map(|(keyframe, _)| (keyframe.key(), keyframe.world_from_depth()))
            .collect();
        self.is_changed = false;
        let newest = known.max_by_key(|(keyframe, _)| keyframe.pose.stamp.0);
        let newest_at = newest.and_then(|(keyframe, _)| captured_at(&keyframe.pose));
        let hub = self.hub.clone();
        let began = Instant::now();
        // The map is computed on another thread, because a map of many keyframes takes longer than
        // a training step.
        let task = Task::start("observations", move || {
            if let Some(map) = map::map_of(&observed) {
                hub.set_observations(&viz::ObservationMap { newest_at, ..map });
            }
        });
        self.task = Some((began, task));
    }

    /// Whether corrections have moved the depth of a keyframe noticeably since the last map.
    fn has_moved(&self, keyframe: &PosedKeyframe) -> bool {
        // A keyframe that is not in the map has no depth yet. When its depth is rendered,
        // `is_changed` is set.
        self.mapped.get(&keyframe.key()).is_some_and(|mapped| {
            transform::is_noticeable(&(mapped.inverse() * keyframe.world_from_depth()))
        })
    }
}

impl PosedKeyframe {
    fn key(&self) -> Key {
        (Arc::clone(&self.pose.camera), self.pose.stamp)
    }

    fn world_from_depth(&self) -> Transform {
        self.pose.world_from_camera * self.color_from_depth
    }
}

impl KnownDepth {
    /// Whether the depth was rendered with a much less trained model. Measured depth is never
    /// outdated.
    #[expect(clippy::cast_precision_loss, reason = "steps are far below 2^52")]
    fn is_outdated(&self, step: u64) -> bool {
        self.rendered_at
            .is_some_and(|at| step as f64 > STEP_FACTOR * at as f64)
    }

    /// The depth of a keyframe with its current pose.
    fn posed(&self, keyframe: &PosedKeyframe) -> PosedDepth {
        PosedDepth {
            stamp: keyframe.pose.stamp,
            depth: DepthMap {
                world_from_camera: keyframe.world_from_depth(),
                ..self.depth.clone()
            },
            pixel_rad: 1.0 / keyframe.pose.focal_px[0],
            is_measured: self.rendered_at.is_none(),
        }
    }
}

/// The request for the depth of a keyframe at a low resolution.
fn depth_request(pose: &KeyframePose, edits: &Arc<Edits>) -> RenderRequest {
    let scale = f64::from(MAX_WIDTH_PX.min(pose.size_px[0])) / f64::from(pose.size_px[0]);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "smaller than the image"
    )]
    let size_px = pose
        .size_px
        .map(|size| ((f64::from(size) * scale).round() as u32).max(1));
    // The rounded size has a slightly different aspect ratio, so each axis has its own scale.
    let axes = [0, 1].map(|axis| f64::from(size_px[axis]) / f64::from(pose.size_px[axis]));
    let scaled = |values: [f64; 2]| [values[0] * axes[0], values[1] * axes[1]];
    RenderRequest {
        world_from_camera: pose.world_from_camera,
        size_px,
        projection: Projection::Pinhole {
            focal_px: scaled(pose.focal_px),
            principal_px: scaled(pose.principal_px),
        },
        shutter: None,
        near_m: 0.01,
        far_m: 100.0,
        crop: None,
        edits: Arc::clone(edits),
        background_srgb: [0.0; 3],
        appearance_of: None,
        depth: true,
    }
}

/// The depth of a rendered picture.
fn depth_map(request: &RenderRequest, picture: Picture) -> DepthMap {
    let Projection::Pinhole {
        focal_px,
        principal_px,
    } = request.projection
    else {
        unreachable!("depth is requested with a pinhole")
    };
    DepthMap {
        size_px: picture.size_px,
        focal_px,
        principal_px,
        depth_m: picture.depth_m.into(),
        world_from_camera: request.world_from_camera,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// A keyframe, and the pose of its depth camera in the frame of its color camera.
    fn posed(world_from_camera: Transform, color_from_depth: Transform) -> PosedKeyframe {
        let pose = KeyframePose {
            camera: "wrist".into(),
            stamp: Stamp(7),
            world_from_camera,
            size_px: [640, 480],
            focal_px: [600.0, 610.0],
            principal_px: [320.0, 240.0],
        };
        PosedKeyframe {
            pose,
            keyframe: None,
            color_from_depth,
        }
    }

    #[test]
    fn requested_depth_has_the_field_of_view_of_the_image() {
        let keyframe = posed(Transform::translation(1.0, 2.0, 3.0), Transform::identity());
        let request = depth_request(&keyframe.pose, &Arc::default());
        let Projection::Pinhole {
            focal_px,
            principal_px,
        } = request.projection
        else {
            panic!("a pinhole")
        };
        assert_eq!(
            (request.size_px, focal_px, principal_px),
            ([96, 72], [90.0, 91.5], [48.0, 36.0])
        );
        assert!(request.depth && request.world_from_camera == keyframe.pose.world_from_camera);
    }

    #[test]
    fn depth_follows_corrections_of_both_cameras() {
        let depth = depth_map(
            &depth_request(
                &posed(Transform::identity(), Transform::identity()).pose,
                &Arc::default(),
            ),
            Picture {
                size_px: [96, 72],
                rgba_srgb: Vec::new(),
                depth_m: vec![1.0; 96 * 72],
            },
        );
        let known = KnownDepth {
            depth,
            rendered_at: None,
        };
        let world_from_camera = Transform::rotation(Vector3::new(0.0, 0.3, 0.0));
        let color_from_depth = Transform::translation(0.05, 0.0, 0.0)
            * Transform::rotation(Vector3::new(0.1, 0.0, 0.2));
        let depth = known.posed(&posed(world_from_camera, color_from_depth));
        let error =
            (world_from_camera * color_from_depth).inverse() * depth.depth.world_from_camera;
        assert!(
            error.translation.vector.norm() < 1e-12 && error.rotation.angle() < 1e-7,
            "{error}"
        );
        assert_eq!(
            (depth.stamp, depth.is_measured, depth.pixel_rad),
            (Stamp(7), true, 1.0 / 600.0)
        );
    }

    #[test]
    fn map_is_computed_again_after_a_noticeable_correction() {
        let mut publisher = ObservationPublisher::new(Hub::new());
        let edits = Arc::default();
        let mut is_computed_at = |x_m: f64| {
            let keyframes = [posed(
                Transform::translation(x_m, 0.0, 0.0),
                Transform::identity(),
            )];
            let model = ModelState {
                step: 1000,
                edits: &edits,
                captured_at: &|_| None,
            };
            publisher.publish(&keyframes, &model, |request| {
                let n = (request.size_px[0] * request.size_px[1]) as usize;
                Ok(Picture {
                    size_px: request.size_px,
                    rgba_srgb: Vec::new(),
                    depth_m: vec![1.0; n],
                })
            });
            publisher
                .task
                .take()
                .is_some_and(|(_, thread)| thread.join().is_ok())
        };
        let computed = [0.0, 0.0, 1e-9, 0.01, 0.01].map(&mut is_computed_at);
        assert_eq!(computed, [true, false, false, true, false]);
    }
}
