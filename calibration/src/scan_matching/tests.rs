use super::*;
use nalgebra::{Translation3, UnitQuaternion};
use numbers::random::Random;

/// Noise of a scanner, meters.
const NOISE_M: f64 = 0.015;

/// An axis-aligned box, as two corners.
type Aabb = [[f64; 3]; 2];

/// The walls of a room from inside, and furniture.
const ROOM: Aabb = [[-4.1, -3.3, 0.0], [4.3, 3.6, 2.7]];
const FURNITURE: [Aabb; 4] = [
    [[-0.4, -0.4, 0.0], [0.4, 0.4, 1.0]],
    [[3.1, -2.0, 0.0], [4.3, 0.5, 0.8]],
    [[-4.1, 1.9, 0.0], [-3.4, 3.0, 1.9]],
    [[-1.0, 3.0, 0.0], [1.4, 3.6, 2.1]],
];

/// Distance from inside of a box to its sides.
fn exit_m(of: &Aabb, origin: &Point3<f64>, direction: &Vector3<f64>) -> f64 {
    let exits = (0..3).map(|axis| {
        let side = of[usize::from(direction[axis] > 0.0)][axis];
        (side - origin[axis]) / direction[axis]
    });
    exits.fold(f64::INFINITY, f64::min)
}

/// Distance to a box from outside; infinite if the ray misses it.
fn entry_m(of: &Aabb, origin: &Point3<f64>, direction: &Vector3<f64>) -> f64 {
    let (mut near, mut far) = (0.0_f64, f64::INFINITY);
    for axis in 0..3 {
        let sides = [0, 1].map(|side| (of[side][axis] - origin[axis]) / direction[axis]);
        near = near.max(sides[0].min(sides[1]));
        far = far.min(sides[0].max(sides[1]));
    }
    if near < far { near } else { f64::INFINITY }
}

/// A scan from a pose: points in the frame of the scanner.
fn scan(
    room: &Aabb,
    furniture: &[Aabb],
    world_from_scanner: &Transform,
    random: &mut Random,
) -> Vec<Point3<f64>> {
    let origin = Point3::from(world_from_scanner.translation.vector);
    let mut points = Vec::new();
    for column in 0..600 {
        for ring in 0..16 {
            let azimuth = f64::from(column) / 600.0 * std::f64::consts::TAU;
            let elevation = (f64::from(ring) - 7.5) * 2.0_f64.to_radians();
            let direction = Vector3::new(
                elevation.cos() * azimuth.cos(),
                elevation.cos() * azimuth.sin(),
                elevation.sin(),
            );
            let in_world = world_from_scanner.rotation * direction;
            let boxes = furniture.iter().map(|of| entry_m(of, &origin, &in_world));
            let range_m = boxes.fold(exit_m(room, &origin, &in_world), f64::min);
            points.push(Point3::from(
                direction * (range_m + NOISE_M * random.normal()),
            ));
        }
    }
    points
}

/// Pose on a lap around the room.
fn on_lap(share: f64) -> Transform {
    let angle = share * std::f64::consts::TAU;
    Transform::from_parts(
        Translation3::new(2.2 * angle.cos(), 2.2 * angle.sin(), 0.7),
        UnitQuaternion::from_scaled_axis(Vector3::new(
            0.01 * (40.0 * angle).sin(),
            0.01 * (31.0 * angle).cos(),
            angle + 0.5 * (3.0 * angle).sin(),
        )),
    )
}

/// Errors of a walk: meters and radians per scan, of odometry and after the correction.
struct Errors {
    odometry: Vec<(f64, f64)>,
    corrected: Vec<(f64, f64)>,
    corrections: Vec<Transform>,
}

fn worst(errors: &[(f64, f64)]) -> (f64, f64) {
    let max = |worst: (f64, f64), of: &(f64, f64)| (worst.0.max(of.0), worst.1.max(of.1));
    errors.iter().fold((0.0, 0.0), max)
}

fn error(of: &Transform, truth: &Transform) -> (f64, f64) {
    (
        (of.translation.vector - truth.translation.vector).norm(),
        of.rotation.angle_to(&truth.rotation),
    )
}

/// A walk whose odometry drifts as a random walk.
struct Walk<'a> {
    n_scans: usize,
    pose: &'a dyn Fn(f64) -> Transform,
    room: Aabb,
    furniture: &'a dyn Fn(f64) -> Vec<Aabb>,
    /// Root mean square drift at the end, meters and radians.
    drift: (f64, f64),
    /// Share of the walk at which the feet slip, and how far, meters.
    slip: Option<(f64, f64)>,
}

impl Walk<'_> {
    fn errors(&self, seed: u64) -> Errors {
        let mut random = Random::new(seed);
        let mut tracker = DriftTracker::new(RangeSensor::Scanner);
        let mut correction = Transform::identity();
        let mut odom_from_world = Transform::identity();
        let mut errors = Errors {
            odometry: Vec::new(),
            corrected: Vec::new(),
            corrections: Vec::new(),
        };
        for ix in 0..self.n_scans {
            let share = ix as f64 / self.n_scans as f64;
            let truth = (self.pose)(share);
            let points = scan(&self.room, &(self.furniture)(share), &truth, &mut random);
            let step = 1.0 / (3.0 * self.n_scans as f64).sqrt();
            // The first pose defines the frame of the map.
            let [m, rad] = if ix == 0 {
                [0.0; 2]
            } else {
                [self.drift.0 * step, self.drift.1 * step]
            };
            let mut error_m = Vector3::from_fn(|_, _| m * random.normal());
            let error_rad = Vector3::from_fn(|_, _| rad * random.normal());
            if let Some((at, slip_m)) = self.slip
                && (share - at).abs() < 0.5 / self.n_scans as f64
            {
                error_m.x += slip_m;
            }
            // An error of odometry turns the rest of its path about the present position.
            let here = (odom_from_world * truth).translation.vector;
            let turn = UnitQuaternion::from_scaled_axis(error_rad);
            let change = Transform::from_parts((here - turn * here + error_m).into(), turn);
            odom_from_world = change * odom_from_world;
            let reported = odom_from_world * truth;
            let guess = correction * reported;
            let in_world: Vec<_> = points.iter().map(|point| guess * point).collect();
            if let Some(found) = tracker.add(&in_world, &guess) {
                correction = found.motion * correction;
            }
            errors.odometry.push(error(&reported, &truth));
            errors
                .corrected
                .push(error(&(correction * reported), &truth));
            errors.corrections.push(correction);
        }
        errors
    }
}

/// A lap in a furnished room.
fn lap<'a>(n_scans: usize, furniture: &'a dyn Fn(f64) -> Vec<Aabb>) -> Walk<'a> {
    Walk {
        n_scans,
        pose: &on_lap,
        room: ROOM,
        furniture,
        drift: (0.05, 0.03),
        slip: None,
    }
}

#[test]
fn drift_of_a_lap_is_corrected_to_millimeters() {
    for seed in 0..2 {
        let errors = lap(80, &|_| FURNITURE.to_vec()).errors(seed);
        let [before, after] = [worst(&errors.odometry), worst(&errors.corrected)];
        assert!(
            before.0 > 0.03 && after.0 < 0.008 && after.1 < 0.0026,
            "{before:?} {after:?}"
        );
    }
}

#[test]
fn a_second_lap_has_the_errors_of_the_first_one() {
    let two_laps = Walk {
        pose: &|share| on_lap(2.0 * share),
        ..lap(120, &|_| FURNITURE.to_vec())
    };
    let errors = two_laps.errors(3);
    let [first, second] = [&errors.corrected[..60], &errors.corrected[60..]].map(worst);
    assert!(
        second.0 < first.0 + 0.002 && second.1 < first.1 + 5e-4,
        "{first:?} {second:?}"
    );
}

#[test]
fn moved_furniture_and_slipping_feet_do_not_disturb_the_correction() {
    // Halfway, two pieces of furniture move by half a meter, and a box appears.
    let furniture = |share: f64| {
        let mut now = FURNITURE.to_vec();
        if share > 0.5 {
            for side in [0, 1] {
                now[0][side][0] += 0.5;
                now[3][side][0] -= 0.5;
            }
            now.push([[-3.0, -3.0, 0.0], [-2.4, -2.2, 1.2]]);
        }
        now
    };
    let walk = Walk {
        slip: Some((0.7, 0.06)),
        ..lap(80, &furniture)
    };
    let errors = walk.errors(4);
    let after = worst(&errors.corrected);
    assert!(after.0 < 0.012 && after.1 < 0.003, "{after:?}");
}

#[test]
fn along_a_corridor_the_base_follows_odometry() {
    // 200 m long: no end is seen. Scans determine five of six directions.
    let corridor = Walk {
        n_scans: 60,
        pose: &|share| Transform::translation(8.0 * share - 4.0, 0.3, 0.7),
        room: [[-100.0, -1.1, 0.0], [100.0, 1.3, 2.6]],
        furniture: &|_| Vec::new(),
        drift: (0.03, 0.02),
        slip: None,
    };
    let errors = corridor.errors(5);
    let along: Vec<f64> = errors
        .corrections
        .iter()
        .map(|of| of.translation.x)
        .collect();
    let [before, after] = [worst(&errors.odometry), worst(&errors.corrected)];
    assert!(
        after.1 < 0.003 && after.0 < before.0 + 0.01,
        "{before:?} {after:?}"
    );
    // Without any surface across the corridor, a correction along it would be noise.
    let largest = along.iter().fold(0.0, |max: f64, x| max.max(x.abs()));
    assert!(largest < 0.03, "{largest}");
}

#[test]
fn a_scan_without_known_surfaces_extends_the_map() {
    let mut tracker = DriftTracker::new(RangeSensor::Scanner);
    let mut random = Random::new(6);
    let here = on_lap(0.0);
    let in_room: Vec<_> = scan(&ROOM, &FURNITURE, &here, &mut random)
        .iter()
        .map(|point| here * point)
        .collect();
    assert!(tracker.add(&in_room, &here).is_none());
    assert!(tracker.add(&in_room, &here).is_some());
    let far = Transform::translation(500.0, 0.0, 0.0);
    let elsewhere: Vec<_> = in_room.iter().map(|point| far * point).collect();
    let there = far * here;
    assert!(tracker.add(&elsewhere, &there).is_none());
    assert!(tracker.add(&elsewhere, &there).is_some());
    // The pose relative to the new surfaces is accurate, but these are as uncertain as odometry
    // after 500 m. Back in the room, the pose is accurate again.
    let sigma_m = |covariance: Matrix6<f64>| covariance.m11.sqrt();
    assert!(sigma_m(tracker.covariance()) > 0.2);
    let located = tracker.locate(&in_room, &here).expect("a known room");
    assert!(sigma_m(located.covariance) < 0.01);
    assert!(sigma_m(tracker.covariance_at(&here)) > 0.2);
    // Nothing can be matched with an empty scan.
    assert!(tracker.add(&[], &there).is_none());
}

#[test]
fn the_same_scans_give_the_same_corrections() {
    let walk = lap(12, &|_| FURNITURE.to_vec());
    assert_eq!(walk.errors(7).corrections, walk.errors(7).corrections);
}
