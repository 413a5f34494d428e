//! The extent of a scene, and the views that clients begin with.

use keyframe::{DepthMap, Keyframe};
use kinematics::Transform;
use nalgebra::{Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use numbers::quantile::{Rank, quantile};
use std::sync::Arc;
use trainer::Bounds;
use viz::{Hub, SceneBounds, SceneHint};

/// Assumed distance of the scene from each camera if the optical axes do not determine it, meters.
/// It is a typical distance between the camera of an arm and its table. With a single camera, the
/// view turns about a point at this distance.
const PRIOR_DISTANCE_M: f64 = 0.5;
/// Weight of the assumed distance relative to one optical axis. It matters only in directions that
/// the axes do not constrain. A larger weight pulls the center away from the point where the axes
/// meet. A smaller weight leaves the center undefined for nearly parallel axes.
const PRIOR_WEIGHT: f64 = 0.01;

/// Distance of an outside view, in outer radii of the model. The whole sphere is then visible in a
/// field of view of 50 degrees (`1 / sin(25 degrees)` is 2.4), also on an upright phone whose view is
/// a quarter narrower than high.
const DISTANCE_RADII: f64 = 3.0;
/// Direction from the model to an outside view: from the front right, 30 degrees above the horizon.
const VIEW_DIRECTION: [f64; 3] = [0.5, -0.707, 0.5];

/// Points per side of the grid of depth readings that a keyframe contributes to the bounds. With
/// 400 keyframes, these are 10,000 points, which takes less than a millisecond.
const GRID: u32 = 5;
/// Fraction of the points left out on each side of the bounds. Such points are often wrong depth
/// readings, or are seen through windows and doors.
const OUTSIDE_FRAC: f64 = 0.03;
/// Minimum radius of a scene, meters. Clients divide by it.
const MIN_RADIUS_M: f64 = 0.01;

/// Extent and first view of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneView {
    /// The smallest box that contains the relevant parts.
    pub bounds: SceneBounds,
    /// View of the first camera or, without cameras, from outside.
    pub world_from_camera: Transform,
}

impl SceneView {
    /// The bounds of the keyframes, and the view of the first one; `None` without keyframes.
    pub fn from_keyframes(keyframes: &[Arc<Keyframe>]) -> Option<Self> {
        let poses: Vec<_> = keyframes
            .iter()
            .map(|keyframe| keyframe.world_from_camera)
            .collect();
        let center = nearest_to_axes(&poses)?;
        let surfaces: Vec<_> = keyframes
            .iter()
            .flat_map(|keyframe| surface_points(keyframe, &center))
            .collect();
        Self::of_points(&poses, &surfaces)
    }

    /// The bounds of a saved model with its cameras, and the view of the first camera; `None` if
    /// both are missing.
    pub fn of_model(cameras: &[Transform], model: Option<&Bounds>) -> Option<Self> {
        let Some(model) = model else {
            let center = nearest_to_axes(cameras)?;
            let ahead: Vec<_> = cameras.iter().map(|pose| ahead(pose, &center)).collect();
            return Self::of_points(cameras, &ahead);
        };
        let around = |side: f64| {
            model
                .center_m
                .map(|along| along + side * model.outer_radius_m)
        };
        let bounds = SceneBounds {
            min_m: around(-1.0),
            max_m: around(1.0),
        };
        Some(Self {
            bounds,
            world_from_camera: cameras.first().copied().unwrap_or_else(|| outside(model)),
        })
    }

    /// The box around all cameras, whose poses are reliable, and around most points of surfaces.
    fn of_points(cameras: &[Transform], surfaces: &[Point3<f64>]) -> Option<Self> {
        let positions = cameras.iter().map(|pose| pose.translation.vector);
        let eyes = bounds_of(positions.map(Point3::from))?;
        let surfaces = most_of(surfaces);
        Some(Self {
            bounds: surfaces.map_or(eyes, |surfaces| union(&eyes, &surfaces)),
            world_from_camera: *cameras.first()?,
        })
    }

    /// A view of a whole box from outside and slightly above, z up.
    #[must_use]
    pub fn outside(bounds: &SceneBounds) -> Transform {
        let radius_m = radius_m(bounds);
        outside(&Bounds {
            center_m: center_m(bounds),
            radius_m,
            outer_radius_m: radius_m,
        })
    }

    /// Sends the extent and the view to clients.
    pub fn publish(&self, hub: &Hub) {
        let hint = SceneHint {
            center_m: center_m(&self.bounds),
            radius_m: radius_m(&self.bounds),
            world_from_camera: self.world_from_camera,
        };
        hub.set_scene(hint, self.bounds);
    }
}

/// The center of a box.
fn center_m(SceneBounds { min_m, max_m }: &SceneBounds) -> [f64; 3] {
    [0, 1, 2].map(|axis| 0.5 * (min_m[axis] + max_m[axis]))
}

/// Half the diagonal of a box, meters.
pub(crate) fn radius_m(bounds: &SceneBounds) -> f64 {
    let diagonal_m = (Vector3::from(bounds.max_m) - Vector3::from(bounds.min_m)).norm();
    (0.5 * diagonal_m).max(MIN_RADIUS_M)
}

/// The smallest box that contains both.
pub(crate) fn union(a: &SceneBounds, b: &SceneBounds) -> SceneBounds {
    SceneBounds {
        min_m: [0, 1, 2].map(|axis| a.min_m[axis].min(b.min_m[axis])),
        max_m: [0, 1, 2].map(|axis| a.max_m[axis].max(b.max_m[axis])),
    }
}

/// The smallest box that contains all points; `None` without points.
fn bounds_of(points: impl Iterator<Item = Point3<f64>>) -> Option<SceneBounds> {
    let around = |point: Point3<f64>| SceneBounds {
        min_m: point.coords.into(),
        max_m: point.coords.into(),
    };
    points.map(around).reduce(|a, b| union(&a, &b))
}

/// A box that contains most points; `None` without points.
fn most_of(points: &[Point3<f64>]) -> Option<SceneBounds> {
    let at = |frac: f64| -> Option<[f64; 3]> {
        let along = |axis: usize| {
            let mut values: Vec<_> = points.iter().map(|point| point[axis]).collect();
            quantile(&mut values, frac, Rank::Nearest)
        };
        Some([along(0)?, along(1)?, along(2)?])
    };
    Some(SceneBounds {
        min_m: at(OUTSIDE_FRAC)?,
        max_m: at(1.0 - OUTSIDE_FRAC)?,
    })
}

/// Points on the surfaces that a keyframe shows, from a grid of its depth readings. Without depth
/// readings, this is the point on its optical axis that is closest to the center of all axes.
fn surface_points(keyframe: &Keyframe, center: &Point3<f64>) -> Vec<Point3<f64>> {
    let measured: Vec<_> = keyframe.depth.iter().flat_map(grid_points).collect();
    if measured.is_empty() {
        vec![ahead(&keyframe.world_from_camera, center)]
    } else {
        measured
    }
}

/// The points of a grid of depth readings, in world.
fn grid_points(depth: &DepthMap) -> impl Iterator<Item = Point3<f64>> {
    let [width, height] = depth.size_px;
    // The middles of equal parts of a side.
    let places = |side: u32| (0..GRID).map(move |ix| side * (2 * ix + 1) / (2 * GRID));
    let pixels = places(height).flat_map(move |y| places(width).map(move |x| [x, y]));
    pixels.filter_map(move |[x, y]| {
        let ix = y as usize * width as usize + x as usize;
        let z_m = f64::from(*depth.depth_m.get(ix)?);
        let is_reading = z_m > 0.0 && z_m.is_finite();
        is_reading.then(|| depth.world_from_camera * Point3::from(depth.point(x, y, z_m)))
    })
}

/// The point on an optical axis that is closest to the center of all axes, but at least half the
/// assumed distance away.
fn ahead(world_from_camera: &Transform, center: &Point3<f64>) -> Point3<f64> {
    let z_m = world_from_camera.inverse_transform_point(center).z;
    world_from_camera * Point3::new(0.0, 0.0, z_m.max(0.5 * PRIOR_DISTANCE_M))
}

/// A view of the whole model from outside and slightly above, z up.
fn outside(bounds: &Bounds) -> Transform {
    let view_direction = Vector3::from(VIEW_DIRECTION).normalize();
    // The axes of a camera: x right, y down, z forward. `right` is horizontal, so that z of the
    // world points up in the picture.
    let forward = -view_direction;
    let right = forward.cross(&Vector3::z()).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let position_m =
        Vector3::from(bounds.center_m) + DISTANCE_RADII * bounds.outer_radius_m * view_direction;
    Transform::from_parts(Translation3::from(position_m), rotation)
}

/// The point with the least squared distances to all optical axes, with a weak prior on the
/// distance from each camera.
pub(crate) fn nearest_to_axes(world_from_cameras: &[Transform]) -> Option<Point3<f64>> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for pose in world_from_cameras {
        let axis = pose.rotation * Vector3::z();
        // The distance of `x` from the axis through `c` is the length of `P (x - c)`, where
        // `P = I - a a^T` removes the component along the axis. The sum of the squares over all
        // axes is smallest where `sum P x = sum P c`. The prior adds `w (x - ahead)^2` per camera.
        let projector = Matrix3::identity() - axis * axis.transpose();
        let ahead = pose.translation.vector + PRIOR_DISTANCE_M * axis;
        normal += projector + PRIOR_WEIGHT * Matrix3::identity();
        right += projector * pose.translation.vector + PRIOR_WEIGHT * ahead;
    }
    Some(Point3::from(normal.cholesky()?.solve(&right)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use keyframe::Split;
    use kinematics::Stamp;

    const TOLERANCE_M: f64 = 1e-9;

    fn camera_at(position: [f64; 3], target: Point3<f64>) -> Transform {
        let position = Point3::from(position);
        let rotation = UnitQuaternion::rotation_between(&Vector3::z(), &(target - position))
            .expect("not opposite");
        Transform::from_parts(Translation3::from(position.coords), rotation)
    }

    #[test]
    fn cameras_around_an_object_converge_on_it() {
        /// The prior shifts the result by about its weight times its error, which is 0.5 m here.
        const TOLERANCE_M: f64 = 0.01;
        let target = Point3::new(0.5, 0.1, 0.05);
        let positions = [
            [1.5, 0.1, 0.05],
            [0.5, 1.1, 0.1],
            [0.4, 0.1, 1.05],
            [0.5, -0.9, 0.3],
        ];
        let center = nearest_to_axes(&positions.map(|position| camera_at(position, target)))
            .expect("cameras");
        assert!((center - target).norm() < TOLERANCE_M, "{center}");
    }

    #[test]
    fn a_single_camera_uses_the_prior_distance() {
        let pose = camera_at([1.0, 2.0, 3.0], Point3::new(1.0, 3.0, 3.0));
        let view = SceneView::of_model(&[pose], None).expect("a camera");
        let expected = SceneBounds {
            min_m: [1.0, 2.0, 3.0],
            max_m: [1.0, 2.5, 3.0],
        };
        for (corner, expected) in [
            (view.bounds.min_m, expected.min_m),
            (view.bounds.max_m, expected.max_m),
        ] {
            let error_m = (Vector3::from(corner) - Vector3::from(expected)).norm();
            assert!(error_m < TOLERANCE_M, "{:?}", view.bounds);
        }
        assert!(SceneView::from_keyframes(&[]).is_none());
        assert!(SceneView::of_model(&[], None).is_none());
    }

    #[test]
    fn the_outside_view_of_a_model_looks_at_its_center_and_is_upright() {
        let model = Bounds {
            center_m: [1.0, 2.0, 3.0],
            radius_m: 0.5,
            outer_radius_m: 0.8,
        };
        let view = SceneView::of_model(&[], Some(&model)).expect("a model");
        assert_eq!(view.bounds.min_m, [1.0 - 0.8, 2.0 - 0.8, 3.0 - 0.8]);
        assert_eq!(view.bounds.max_m, [1.0 + 0.8, 2.0 + 0.8, 3.0 + 0.8]);
        let pose = view.world_from_camera;
        let center_in_camera = pose.inverse() * Point3::from(model.center_m);
        assert!(
            (center_in_camera - Point3::new(0.0, 0.0, 2.4)).norm() < TOLERANCE_M,
            "{center_in_camera}"
        );
        // The edge of the field of view is 25 degrees from the axis.
        let angle = (model.outer_radius_m / center_in_camera.z).asin();
        assert!(angle < 25_f64.to_radians(), "{angle} rad");
        let right = pose.rotation * Vector3::x();
        let down = pose.rotation * Vector3::y();
        assert!(
            right.z.abs() < TOLERANCE_M && down.z < -0.5,
            "{right} {down}"
        );
        assert!(pose.translation.vector.z > model.center_m[2]);
    }

    /// A keyframe of a wall `depth_m` ahead.
    fn keyframe_of_wall(world_from_camera: Transform, depth_m: f32) -> Arc<Keyframe> {
        let (size_px, focal_px, principal_px) = ([8, 6], [4.0; 2], [4.0, 3.0]);
        Arc::new(Keyframe {
            camera: "wrist".into(),
            stamp: Stamp(0),
            size_px,
            focal_px,
            principal_px,
            rgba_srgb: vec![128; 8 * 6 * 4].into(),
            depth: Some(DepthMap {
                size_px,
                focal_px,
                principal_px,
                depth_m: vec![depth_m; 8 * 6].into(),
                world_from_camera,
            }),
            world_from_camera,
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::Train,
            truth: None,
            robot: None,
        })
    }

    #[test]
    fn the_bounds_contain_all_cameras_and_their_surfaces_but_no_stray_readings() {
        // Each camera is 1 cm farther to the right and looks along z.
        let mut keyframes: Vec<_> = (0..60)
            .map(|ix| keyframe_of_wall(Transform::translation(0.01 * f64::from(ix), 0.0, 0.0), 2.0))
            .collect();
        let bounds = |keyframes: &[Arc<Keyframe>]| {
            SceneView::from_keyframes(keyframes)
                .expect("keyframes")
                .bounds
        };
        let expected = bounds(&keyframes);
        assert_eq!((expected.min_m[2], expected.max_m[2]), (0.0, 2.0));
        assert!(
            expected.min_m[0] < -1.0 && expected.max_m[0] > 1.59,
            "{expected:?}"
        );
        // Readings without a value are left out, and so is a wrong one among 60.
        keyframes[20] = keyframe_of_wall(keyframes[20].world_from_camera, f32::NAN);
        keyframes[40] = keyframe_of_wall(keyframes[40].world_from_camera, 100.0);
        let with_stray = bounds(&keyframes);
        assert_eq!((with_stray.min_m[2], with_stray.max_m[2]), (0.0, 2.0));
        // Without any depth, the scene is assumed ahead of the cameras.
        let without = keyframe_of_wall(Transform::identity(), 0.0);
        let [near, far] = [0, 1].map(|side| {
            let bounds = bounds(&[Arc::clone(&without)]);
            [bounds.min_m, bounds.max_m][side][2]
        });
        assert!(near.abs() < TOLERANCE_M && (far - PRIOR_DISTANCE_M).abs() < TOLERANCE_M);
    }
}
