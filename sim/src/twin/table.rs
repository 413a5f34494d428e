//! Places the table with its objects where the cameras of a rig see it, and plans the tour of a
//! camera on the arm.

use super::body::lowest_z_m;
use super::follower::{TableTour, TwinFollower, TwinTour};
use super::model::TwinModel;
use super::trial::{Trial, sees};
use super::viewpoints::{View, ViewLimits, Viewpoint, n_directions, sampled, views_of};
use crate::Error;
use crate::config::{CameraConfig, Config, Parent};
use crate::joints::Joints;
use crate::objects::{TABLE_Z_M, TARGET_XY_M};
use crate::scan::{LOOK_AT_HEIGHT_M, Scan, ScanShape};
use kinematics::{Intrinsics, Transform};
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use std::sync::Arc;

/// Where the table is, and how the arm moves.
pub(crate) struct TablePlan {
    pub(crate) world_from_scene: Transform,
    /// The motion of the arm. `None` without an arm.
    pub(crate) follower: Option<TwinFollower>,
}

/// The robot at its place.
pub(crate) struct PlacedRobot<'a> {
    pub(crate) model: &'a Arc<TwinModel>,
    pub(crate) world_from_base: Transform,
    pub(crate) max_blur_px: f64,
    pub(crate) max_shear_px: f64,
}

/// Width of the objects on the table, meters. At the preferred distance, they fill most of the
/// image.
const SCENE_WIDTH_M: f64 = 0.32;
/// Smallest and largest preferred distance, meters. At the smallest distance, the camera does not
/// touch the objects. At the largest distance, the objects still fill some pixels.
const DISTANCE_RANGE_M: [f64; 2] = [0.22, 0.9];
/// Smallest and largest distance relative to the preferred distance.
const DISTANCE_SHARE: [f64; 2] = [0.6, 1.9];
/// Number of places that are rated. The next constants are the number of places that are tried, and
/// the smallest distance between two of these places in meters.
const N_RATED: usize = 240;
const N_TRIED: usize = 8;
const MIN_APART_M: f64 = 0.08;
/// Factors on the size of the tour that are tried. An arm can often follow a small tour at a place
/// where its limits prevent a large tour.
const TOUR_SIZES: [f64; 3] = [1.0, 0.6, 0.35];
/// Quality of a scan at which the search ends. The next constant is the smallest quality of a scan.
const GOOD_QUALITY: f64 = 0.9;
const MIN_QUALITY: f64 = 0.1;
/// Largest amplitudes of a tour. Azimuth and elevation are in degrees, and the distance is a
/// fraction.
const MAX_AMPLITUDES: [f64; 3] = [45.0, 20.0, 0.28];
/// Distance from the center of the target area to the near edge of the table, meters. The next
/// constant is the space that a robot needs in front of the table.
const TABLE_EDGE_M: f64 = 0.34;
const BASE_HALF_M: f64 = 0.14;
/// A small arm prefers a distance of at most this fraction of its reach.
const DISTANCE_REACH_FRAC: f64 = 0.75;
/// Height difference between table and robot at which a place loses a large part of its rating,
/// meters. The next constant is this part of the rating.
const HEIGHT_TOLERANCE_M: f64 = 0.3;
const HEIGHT_WEIGHT: f64 = 0.6;
/// Largest height of the table above the lowest point of the robot, meters. The floor is 0.87 m
/// below the table.
const MAX_TABLE_HEIGHT_M: f64 = 0.8;
/// Fraction of the largest allowed motion blur and shear that the scan uses. Depth and speed vary
/// within an image.
const MOTION_BUDGET_FRAC: f64 = 0.6;
/// Slowest scan relative to `sim.speed`.
const MIN_SLOWDOWN: f64 = 0.02;

/// Plans the scene of a rig.
///
/// # Errors
///
/// Fails if a camera cannot see the table.
pub(crate) fn plan(config: &Config, robot: &PlacedRobot<'_>) -> Result<TablePlan, Error> {
    let n_joints = robot.model.n_joints();
    let on_flange = config
        .cameras
        .iter()
        .find(|camera| camera.parent == Parent::Flange);
    let fixed = fixed_cameras(config, robot);
    let plan = match on_flange {
        Some(camera) if n_joints > 0 => plan_scan(config, robot, camera, &fixed)?,
        _ => TablePlan {
            world_from_scene: before_cameras(&fixed, robot)?,
            follower: (n_joints > 0).then(|| {
                TwinFollower::new(
                    Arc::clone(robot.model),
                    TwinTour::Sway(config.speed),
                    robot.model.rest(),
                )
            }),
        },
    };
    check_cameras(config, robot, &fixed, &plan)?;
    Ok(plan)
}

/// A camera that does not move.
struct FixedCamera<'a> {
    camera: &'a CameraConfig,
    world_from_camera: Transform,
}

impl FixedCamera<'_> {
    fn sees(&self, point: &Point3<f64>) -> bool {
        sees(&self.camera.intrinsics, &self.world_from_camera, point)
    }
}

/// Cameras in the world and on a fixed base.
fn fixed_cameras<'a>(config: &'a Config, robot: &PlacedRobot<'_>) -> Vec<FixedCamera<'a>> {
    let cameras = config.cameras.iter().filter_map(|camera| {
        let world_from_parent = match camera.parent {
            Parent::World => Transform::identity(),
            Parent::Base => robot.world_from_base,
            Parent::Flange => return None,
        };
        Some(FixedCamera {
            camera,
            world_from_camera: world_from_parent * camera.parent_from_camera,
        })
    });
    cameras.collect()
}

/// Center of the objects on the table, in the scene.
fn center_in_scene() -> Point3<f64> {
    let [x, y] = TARGET_XY_M;
    Point3::new(x, y, TABLE_Z_M + LOOK_AT_HEIGHT_M)
}

/// Pose of the scene with its center at a point, rotated about z.
fn world_from_scene(center: &Point3<f64>, yaw_rad: f64) -> Transform {
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad);
    let rotated = Transform::from_parts(Translation3::identity(), yaw);
    Translation3::from(center - rotated * center_in_scene()) * rotated
}

/// Preferred distance of a camera from the objects, meters.
fn preferred_distance_m(intrinsics: &Intrinsics) -> f64 {
    let narrow = (0..2)
        .map(|axis| f64::from(intrinsics.size_px[axis]) / intrinsics.focal_px[axis])
        .fold(f64::INFINITY, f64::min);
    let [nearest, farthest] = DISTANCE_RANGE_M;
    (SCENE_WIDTH_M / narrow).clamp(nearest, farthest)
}

/// A place of the objects.
struct Place {
    center: Point3<f64>,
    yaw_rad: f64,
    rating: f64,
    /// Number of fixed cameras that see it.
    n_seeing: usize,
    views: Vec<View>,
}

/// Finds a place that the camera on the arm can see from many directions, and a tour around it.
fn plan_scan(
    config: &Config,
    robot: &PlacedRobot<'_>,
    camera: &CameraConfig,
    fixed: &[FixedCamera<'_>],
) -> Result<TablePlan, Error> {
    let viewpoints = sampled(
        robot.model,
        &robot.world_from_base,
        &camera.parent_from_camera,
    );
    let within_reach_m = DISTANCE_REACH_FRAC * reach_m(robot, &viewpoints);
    let preferred_m = preferred_distance_m(&camera.intrinsics)
        .min(within_reach_m)
        .max(DISTANCE_RANGE_M[0]);
    let nearest_depth_m = camera.depth.as_ref().map_or(0.0, |depth| depth.min_m);
    let limits = ViewLimits {
        distance_m: [
            (DISTANCE_SHARE[0] * preferred_m).max(nearest_depth_m + 0.08),
            (DISTANCE_SHARE[1] * preferred_m).max(nearest_depth_m + 0.3),
        ],
        off_axis_rad: off_axis_rad(&camera.intrinsics),
    };
    let mut places = rated_places(robot, &viewpoints, &limits, fixed, preferred_m);
    // Fixed cameras cannot be moved, so as many of them as possible must see the place.
    let most_seeing = places.iter().map(|place| place.n_seeing).max();
    places.retain(|place| Some(place.n_seeing) == most_seeing);
    places.sort_by(|a, b| b.rating.total_cmp(&a.rating));
    let mut best: Option<(f64, Trial, TablePlan)> = None;
    for place in apart(places) {
        let world_from_scene = world_from_scene(&place.center, place.yaw_rad);
        let target_in_base = robot.world_from_base.inverse_transform_point(&place.center);
        let posture = middle_posture(robot, &place, &viewpoints);
        for size in TOUR_SIZES {
            let shape = tour_shape(&place.views, size);
            let tour = TableTour {
                scan: Scan::new(config.speed, config.azimuth_only).with_shape(shape),
                base_from_scene: robot.world_from_base.inverse() * world_from_scene,
                flange_from_camera: camera.parent_from_camera,
            };
            let follower = |scan| {
                let tour = TwinTour::Table(TableTour { scan, ..tour });
                TwinFollower::new(Arc::clone(robot.model), tour, posture.clone())
            };
            let trial = Trial::of(follower(tour.scan), camera, &target_in_base);
            // Between equal scans, the better place comes first.
            if best
                .as_ref()
                .is_some_and(|(quality, ..)| trial.quality() <= *quality)
            {
                continue;
            }
            let slowdown = slowdown(robot, camera, &trial);
            let plan = TablePlan {
                world_from_scene,
                follower: Some(follower(tour.scan.with_speed(tour.scan.speed() * slowdown))),
            };
            best = Some((trial.quality(), trial, plan));
        }
        if best
            .as_ref()
            .is_some_and(|(quality, ..)| *quality >= GOOD_QUALITY)
        {
            break;
        }
    }
    match best {
        Some((quality, trial, plan)) if quality >= MIN_QUALITY => {
            report(camera, robot, &trial);
            Ok(plan)
        }
        _ => Err(Error::CannotScan {
            camera: camera.name.clone(),
            reason:
                "within the joint limits, the arm cannot point it at a table from different sides"
                    .to_owned(),
            remedy: format!(
                "check camera.{}.parent_from_camera, whose z axis is the viewing direction, arm.flange_link, and the \
                 joint limits of the URDF",
                camera.name
            ),
        }),
    }
}

/// Distance from the base within which nearly all sampled cameras are, meters.
fn reach_m(robot: &PlacedRobot<'_>, viewpoints: &[Viewpoint]) -> f64 {
    let base = robot.world_from_base.translation.vector;
    let mut distances: Vec<f64> = viewpoints
        .iter()
        .map(|viewpoint| (viewpoint.world_from_camera.translation.vector - base).norm())
        .collect();
    distances.sort_by(f64::total_cmp);
    distances[distances.len() * 49 / 50]
}

/// Largest angle between the optical axis and the center of the objects, so that most of them are
/// in the image.
fn off_axis_rad(intrinsics: &Intrinsics) -> f64 {
    let half = |axis: usize| {
        (0.5 * f64::from(intrinsics.size_px[axis]) / intrinsics.focal_px[axis]).atan()
    };
    0.35 * (half(0) + half(1))
}

/// Rates places in front of sampled cameras.
fn rated_places(
    robot: &PlacedRobot<'_>,
    viewpoints: &[Viewpoint],
    limits: &ViewLimits,
    fixed: &[FixedCamera<'_>],
    distance_m: f64,
) -> Vec<Place> {
    const MIN_DOWNWARD: f64 = 0.25; // Cameras that look up or ahead see no table.
    let base = robot.world_from_base.translation.vector;
    let base_forward = robot.world_from_base.rotation * Vector3::x();
    let lowest_m = lowest_z_m(robot.model, &robot.world_from_base);
    let downward: Vec<&Viewpoint> = viewpoints
        .iter()
        .filter(|viewpoint| (viewpoint.world_from_camera.rotation * Vector3::z()).z < -MIN_DOWNWARD)
        .collect();
    let stride = (downward.len() / N_RATED).max(1);
    let mut places = Vec::new();
    for viewpoint in downward.into_iter().step_by(stride) {
        let in_front = viewpoint.world_from_camera * Point3::new(0.0, 0.0, distance_m);
        let from_base = in_front.coords - base;
        let away_m = from_base.xy().norm();
        let is_at_base = robot.model.stands_on_base() && away_m < TABLE_EDGE_M + BASE_HALF_M;
        let Some(center) = with_room_for_base(in_front, is_at_base, lowest_m) else {
            continue;
        };
        // Close to the base's axis, the direction to the place is not meaningful.
        let direction = if away_m > 0.1 {
            from_base
        } else {
            base_forward
        };
        let yaw_rad = direction.y.atan2(direction.x);
        let views = views_of(&center, yaw_rad, viewpoints, limits);
        if views.is_empty() {
            continue;
        }
        // Places in front of the robot are preferred to places beside and behind it. Places at some
        // distance are preferred to places on its base.
        let turn_frac = direction.xy().angle(&base_forward.xy()) / std::f64::consts::PI;
        // A robot usually stands on the table or at the height of the table. A robot with a torso
        // stands on the floor.
        let height_m = (center.z - LOOK_AT_HEIGHT_M - lowest_m).abs();
        let height_frac = if robot.model.stands_on_base() {
            (height_m / HEIGHT_TOLERANCE_M).min(1.0)
        } else {
            0.0
        };
        let many_views = (views.len() as f64 / 40.0).min(1.0);
        let rating = (f64::from(n_directions(&views)) + many_views)
            * (1.0 - 0.25 * turn_frac)
            * (1.0 - HEIGHT_WEIGHT * height_frac)
            * (away_m / 0.2).clamp(0.3, 1.0);
        places.push(Place {
            center,
            yaw_rad,
            rating,
            n_seeing: fixed.iter().filter(|camera| camera.sees(&center)).count(),
            views,
        });
    }
    places
}

/// The place, which is lowered if the table would otherwise be inside the base. `None` if the table
/// is too high.
fn with_room_for_base(
    mut center: Point3<f64>,
    is_at_base: bool,
    lowest_m: f64,
) -> Option<Point3<f64>> {
    let table_z_m = center.z - LOOK_AT_HEIGHT_M;
    if is_at_base && table_z_m > lowest_m {
        // The robot stands on the table.
        center.z -= table_z_m - lowest_m;
    }
    (table_z_m < lowest_m + MAX_TABLE_HEIGHT_M).then_some(center)
}

/// The best places that are apart from each other.
fn apart(places: Vec<Place>) -> Vec<Place> {
    let mut kept: Vec<Place> = Vec::new();
    for place in places {
        if kept.len() >= N_TRIED {
            break;
        }
        if kept
            .iter()
            .all(|other| (other.center - place.center).norm() > MIN_APART_M)
        {
            kept.push(place);
        }
    }
    kept
}

/// Ranges of azimuth, elevation and distance that contain most views, each as middle and half
/// width.
fn spans(views: &[View]) -> [[f64; 2]; 3] {
    [
        |view: &View| view.azimuth_degrees,
        |view: &View| view.elevation_degrees,
        |view: &View| view.distance_m,
    ]
    .map(|quantity| span(views, quantity))
}

/// Shape of a tour through most of the views, scaled by `size`.
fn tour_shape(views: &[View], size: f64) -> ScanShape {
    let [azimuth, elevation, distance] = spans(views);
    let default = ScanShape::default();
    let [max_azimuth, max_elevation, max_distance_frac] = MAX_AMPLITUDES;
    ScanShape {
        azimuth_degrees: default
            .azimuth_degrees
            .over(azimuth[0], size * azimuth[1].min(max_azimuth)),
        elevation_degrees: default
            .elevation_degrees
            .over(elevation[0], size * elevation[1].min(max_elevation)),
        distance_m: default.distance_m.over(
            distance[0],
            size * distance[1].min(max_distance_frac * distance[0]),
        ),
    }
}

/// The sampled posture with which the tour begins. Its view is close to the middle of all views,
/// and as few links as possible are inside the table.
fn middle_posture(robot: &PlacedRobot<'_>, place: &Place, viewpoints: &[Viewpoint]) -> Joints {
    /// A link inside the table outweighs any view.
    const INSIDE_PENALTY: f64 = 10.0;
    let [azimuth, elevation, distance] = spans(&place.views);
    let penalty = |view: &View| {
        let off_center = (view.azimuth_degrees - azimuth[0]).abs() / 30.0
            + (view.elevation_degrees - elevation[0]).abs() / 20.0
            + (view.distance_m - distance[0]).abs() / distance[0];
        let position = &viewpoints[view.viewpoint_ix].position;
        off_center + INSIDE_PENALTY * n_links_inside(robot, place, position) as f64
    };
    let (_, best) = place
        .views
        .iter()
        .map(|view| (penalty(view), view))
        .min_by(|(a, _), (b, _)| a.total_cmp(b))
        .expect("a place has views");
    viewpoints[best.viewpoint_ix].position.clone()
}

/// Number of links whose origin is below the top of the table and close to its objects. The scan
/// does not check collisions, so the side on which the links are follows from its first posture.
fn n_links_inside(robot: &PlacedRobot<'_>, place: &Place, position: &Joints) -> usize {
    const MARGIN_M: f64 = 0.02; // A robot that stands on the table touches it.
    const NEAR_M: f64 = 0.55;
    let table_z_m = place.center.z - LOOK_AT_HEIGHT_M;
    let links = robot.model.base_from_links(position);
    links
        .iter()
        .filter(|base_from_link| {
            let origin = (robot.world_from_base * *base_from_link).translation.vector;
            let away = origin.xy() - place.center.coords.xy();
            origin.z < table_z_m - MARGIN_M && away.norm() < NEAR_M
        })
        .count()
}

/// Middle and half width of the range that contains most values.
fn span(views: &[View], quantity: fn(&View) -> f64) -> [f64; 2] {
    const OUTSIDE_FRAC: f64 = 0.15;
    let mut values: Vec<f64> = views.iter().map(quantity).collect();
    values.sort_by(f64::total_cmp);
    let last = values.len() - 1;
    let n_outside = (OUTSIDE_FRAC * last as f64).round();
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a fraction of the number of values"
    )]
    let n_outside = n_outside as usize;
    let [low, high] = [values[n_outside], values[last - n_outside]];
    [0.5 * (low + high), 0.5 * (high - low)]
}

/// Factor on the speed with which motion blur and shear stay within their limits.
fn slowdown(robot: &PlacedRobot<'_>, camera: &CameraConfig, trial: &Trial) -> f64 {
    let allowed = |max_px: f64, micros: f64| MOTION_BUDGET_FRAC * max_px / (1e-6 * micros);
    let allowed_px_s = allowed(robot.max_blur_px, camera.sensor.exposure_micros)
        .min(allowed(robot.max_shear_px, camera.sensor.readout_micros));
    (allowed_px_s / trial.fast_px_s).clamp(MIN_SLOWDOWN, 1.0)
}

fn report(camera: &CameraConfig, robot: &PlacedRobot<'_>, trial: &Trial) {
    let slowdown = slowdown(robot, camera, trial);
    if slowdown < 1.0 {
        log::info!(
            "the simulated scan runs at {:.0} % of its usual speed, so that images of camera {:?} are not blurred with \
             an exposure of {:.1} ms",
            100.0 * slowdown,
            camera.name,
            1e-3 * camera.sensor.exposure_micros
        );
    }
    log::info!(
        "simulated scan: camera {:?} sees the table for {:.0} % of the time, from directions {:.0} degrees apart (RMS)",
        camera.name,
        100.0 * trial.visible_frac,
        trial.spread_rad.to_degrees()
    );
}

/// Places the scene in front of fixed cameras.
fn before_cameras(fixed: &[FixedCamera<'_>], robot: &PlacedRobot<'_>) -> Result<Transform, Error> {
    const MAX_UPWARD: f64 = 0.5; // Cosine of the angle to the vertical.
    /// Smallest height above the table, meters, at which a camera that looks ahead sees the top of
    /// the table.
    const MIN_ABOVE_TABLE_M: f64 = 0.18;
    const N_DISTANCES: u32 = 24;
    const MAX_DISTANCE_M: f64 = 3.0;
    let Some(first) = fixed.first() else {
        // Without cameras, the table has the same place as the table of a Panda.
        let center = robot.world_from_base.translation.vector + center_in_scene().coords;
        return Ok(world_from_scene(&center.into(), 0.0));
    };
    let forward = first.world_from_camera.rotation * Vector3::z();
    if forward.z > MAX_UPWARD {
        return Err(never_sees(first.camera, "it looks up"));
    }
    let yaw_forward = if forward.xy().norm() > 0.05 {
        forward
    } else {
        // The upper edge of the image points away from the viewer.
        -(first.world_from_camera.rotation * Vector3::y())
    };
    let yaw_rad = yaw_forward.y.atan2(yaw_forward.x);
    let preferred_m = 1.4 * preferred_distance_m(&first.camera.intrinsics);
    let eye_z_m = first.world_from_camera.translation.vector.z;
    let centers = (0..N_DISTANCES).map(|ix| {
        let share = f64::from(ix) / f64::from(N_DISTANCES - 1);
        let distance_m = preferred_m + (MAX_DISTANCE_M - preferred_m).max(0.0) * share * share;
        let mut center = first.world_from_camera * Point3::new(0.0, 0.0, distance_m);
        center.z = center.z.min(eye_z_m + LOOK_AT_HEIGHT_M - MIN_ABOVE_TABLE_M);
        center
    });
    let n_seeing = |center: &Point3<f64>| fixed.iter().filter(|camera| camera.sees(center)).count();
    // The first of several equal places is used, because it is the closest to the preferred
    // distance.
    let mut best: Option<(usize, Point3<f64>)> = None;
    for center in centers {
        let n = n_seeing(&center);
        if best.is_none_or(|(most, _)| n > most) {
            best = Some((n, center));
        }
    }
    let (_, center) = best.expect("there are several distances");
    Ok(world_from_scene(&center, yaw_rad))
}

/// Checks that each camera sees the objects on the table.
fn check_cameras(
    config: &Config,
    robot: &PlacedRobot<'_>,
    fixed: &[FixedCamera<'_>],
    plan: &TablePlan,
) -> Result<(), Error> {
    let center = plan.world_from_scene * center_in_scene();
    if let Some(blind) = fixed.iter().find(|camera| !camera.sees(&center)) {
        return Err(never_sees(blind.camera, "the table is not in its image"));
    }
    let Some(follower) = &plan.follower else {
        return Ok(());
    };
    let center_in_base = robot.world_from_base.inverse_transform_point(&center);
    let on_flange = config
        .cameras
        .iter()
        .filter(|camera| camera.parent == Parent::Flange);
    for camera in on_flange {
        if Trial::of(follower.clone(), camera, &center_in_base).visible_frac <= 0.0 {
            return Err(never_sees(camera, "it looks away from the table"));
        }
    }
    Ok(())
}

fn never_sees(camera: &CameraConfig, why: &str) -> Error {
    let name = &camera.name;
    Error::CannotScan {
        camera: name.clone(),
        reason: format!("it never sees the scene: {why}"),
        remedy: format!(
            "correct camera.{name}.parent_from_camera, whose z axis is the viewing direction, or remove this camera \
             from a copy of the rig file"
        ),
    }
}
