//! Simulated measurements of a chessboard with a known camera pose. The corners are computed
//! without rendering.

use calibration::hand_eye::{BoardObservation, HandEyeInput, HandEyeOptions, HandEyeSample, Setup};
use calibration::{BoardPoint, BoardView, board_pose};
use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use numbers::random::Random;

const COLUMNS: u32 = 9;
const ROWS: u32 = 6;
const SQUARE_M: f64 = 0.025;
/// Typical distance of the board, meters.
const DISTANCE_M: f64 = 0.5;
/// Maximum number of attempts to find a pose from which the whole board is visible.
const MAX_ATTEMPTS: usize = 500;

/// A camera on a flange and a board in the base.
pub(super) struct Scene {
    pub(super) flange_from_camera: Transform,
    pub(super) base_from_board: Transform,
    /// True robot poses.
    pub(super) base_from_flange: Vec<Transform>,
}

/// Standard deviations of the measurements.
#[derive(Clone, Copy, Debug)]
pub(super) struct Noise {
    pub(super) corner_px: f64,
    pub(super) robot_rad: f64,
    pub(super) robot_m: f64,
}

pub(super) fn intrinsics(lens: Lens) -> Intrinsics {
    Intrinsics {
        size_px: [1280, 720],
        focal_px: [900.0, 905.0],
        principal_px: [643.0, 358.0],
        lens,
        rectified: false,
    }
}

/// The lens of hand-eye scenes.
pub(super) fn brown_conrady() -> Lens {
    Lens::BrownConrady([-0.12, 0.05, 0.0005, -0.0003, 0.0])
}

fn corners() -> impl Iterator<Item = Vector3<f64>> {
    let at =
        |row: u32, column: u32| Vector3::new(f64::from(column), f64::from(row), 0.0) * SQUARE_M;
    (0..ROWS).flat_map(move |row| (0..COLUMNS).map(move |column| at(row, column)))
}

fn normal_vector(random: &mut Random, scale: f64) -> Vector3<f64> {
    Vector3::new(random.normal(), random.normal(), random.normal()) * scale
}

/// A pose from which the whole board is visible. It is rotated about a random axis by a normally
/// distributed angle.
pub(super) fn camera_from_board(
    intrinsics: &Intrinsics,
    spread_rad: f64,
    random: &mut Random,
) -> Transform {
    const MAX_TILT_RAD: f64 = 1.0;
    let center = Vector3::new(f64::from(COLUMNS - 1), f64::from(ROWS - 1), 0.0) * (0.5 * SQUARE_M);
    let mut pose = Transform::identity();
    for _ in 0..MAX_ATTEMPTS {
        let mut turn = normal_vector(random, spread_rad);
        // At larger tilts, the corners of a real board would be hard to detect. Rotations about the
        // optical axis are not limited.
        turn.x = turn.x.clamp(-MAX_TILT_RAD, MAX_TILT_RAD);
        turn.y = turn.y.clamp(-MAX_TILT_RAD, MAX_TILT_RAD);
        let rotation = UnitQuaternion::from_scaled_axis(turn);
        let at = Vector3::new(0.0, 0.0, DISTANCE_M) + normal_vector(random, 0.05);
        pose = Transform::from_parts((at - rotation * center).into(), rotation);
        if view(intrinsics, &pose, 0.0, random).points.len() == corners().count() {
            break;
        }
    }
    pose
}

/// The corners inside the image, with normal errors.
pub(super) fn view(
    intrinsics: &Intrinsics,
    pose: &Transform,
    noise_px: f64,
    random: &mut Random,
) -> BoardView {
    let mut points = Vec::new();
    for point_in_board in corners() {
        let point_in_camera = pose * Point3::from(point_in_board);
        let Some(pixel) = intrinsics.project(&point_in_camera.coords) else {
            continue;
        };
        // Without noise, no random numbers are drawn. The search for a pose must not affect the
        // noise of the scene.
        let pixel = if noise_px > 0.0 {
            pixel.map(|value| value + noise_px * random.normal())
        } else {
            pixel
        };
        if intrinsics.contains(pixel) {
            points.push(BoardPoint {
                point_in_board,
                pixel,
            });
        }
    }
    BoardView {
        name: String::new(),
        points,
    }
}

impl Scene {
    /// `spread_rad`: standard deviation of the rotation of the flange about each axis.
    pub(super) fn new(n_poses: usize, spread_rad: f64, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let flange_from_camera = Transform::new(
            Vector3::new(0.05, -0.03, 0.08),
            Vector3::new(0.1, -0.2, 1.6),
        );
        let base_from_board =
            Transform::new(Vector3::new(0.6, 0.1, 0.02), Vector3::new(3.0, 0.1, -0.2));
        let lens = intrinsics(brown_conrady());
        let base_from_flange = (0..n_poses).map(|_| {
            let pose = camera_from_board(&lens, spread_rad, &mut random);
            base_from_board * pose.inverse() * flange_from_camera.inverse()
        });
        Self {
            flange_from_camera,
            base_from_board,
            base_from_flange: base_from_flange.collect(),
        }
    }

    /// Measured robot poses and corners.
    pub(super) fn samples(&self, noise: Noise, seed: u64) -> Vec<HandEyeSample> {
        // This seed differs from the seed of the scene. Otherwise, the random numbers of the scene
        // would repeat as noise.
        let mut random = Random::new(seed ^ 0x5eed_0000);
        let lens = intrinsics(brown_conrady());
        let mut samples = Vec::new();
        for (ix, pose) in self.base_from_flange.iter().enumerate() {
            let error = Transform::new(
                normal_vector(&mut random, noise.robot_m),
                normal_vector(&mut random, noise.robot_rad),
            );
            let camera_from_board =
                (pose * self.flange_from_camera).inverse() * self.base_from_board;
            let board = view(&lens, &camera_from_board, noise.corner_px, &mut random);
            samples.push(HandEyeSample {
                name: format!("{ix}"),
                base_from_flange: pose * error,
                board: BoardObservation::View(board),
                joints: None,
            });
        }
        samples
    }
}

/// The samples with the poses of the board instead of its corners. Samples without a pose are left
/// out.
pub(super) fn with_board_poses(samples: &[HandEyeSample]) -> Vec<HandEyeSample> {
    let lens = intrinsics(brown_conrady());
    samples
        .iter()
        .filter_map(|sample| with_board_pose(sample, &lens))
        .collect()
}

/// A sample with the pose of the board. `None` if its corners do not determine a pose.
fn with_board_pose(sample: &HandEyeSample, lens: &Intrinsics) -> Option<HandEyeSample> {
    let BoardObservation::View(view) = &sample.board else {
        return Some(sample.clone());
    };
    let board = BoardObservation::Pose(board_pose(lens, &view.points)?.camera_from_board);
    Some(HandEyeSample {
        board,
        ..sample.clone()
    })
}

/// Input for these samples.
pub(super) fn input(samples: Vec<HandEyeSample>, options: HandEyeOptions) -> HandEyeInput<'static> {
    let has_corners = samples
        .iter()
        .any(|sample| matches!(sample.board, BoardObservation::View(_)));
    HandEyeInput {
        setup: Setup::EyeInHand,
        samples,
        intrinsics: has_corners.then(|| intrinsics(brown_conrady())),
        intrinsics_covariance: None,
        board_symmetries: &[],
        chain: None,
        options,
    }
}
