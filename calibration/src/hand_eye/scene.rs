//! Simulated calibrations with a known truth, for tests.

use super::{BoardObservation, HandEyeInput, HandEyeOptions, HandEyeSample, Setup};
use crate::{BoardPoint, BoardView};
use kinematics::random::Random;
use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{Point3, UnitQuaternion, Vector3};

pub(crate) const N_COLUMNS: u32 = 9;
pub(crate) const N_ROWS: u32 = 6;
pub(crate) const SQUARE_M: f64 = 0.025;

pub(crate) fn intrinsics() -> Intrinsics {
    Intrinsics {
        size_px: [1280, 720],
        focal_px: [900.0, 905.0],
        principal_px: [643.0, 358.0],
        lens: Lens::BrownConrady([-0.12, 0.05, 0.0005, -0.0003, 0.0]),
        rectified: false,
    }
}

pub(crate) fn board_points() -> Vec<Vector3<f64>> {
    let point =
        |row: u32, column: u32| Vector3::new(f64::from(column), f64::from(row), 0.0) * SQUARE_M;
    (0..N_ROWS)
        .flat_map(|row| (0..N_COLUMNS).map(move |column| point(row, column)))
        .collect()
}

/// Half turn of the board about its center.
pub(crate) fn half_turn() -> Transform {
    let last = Vector3::new(f64::from(N_COLUMNS - 1), f64::from(N_ROWS - 1), 0.0) * SQUARE_M;
    Transform::new(last, Vector3::z() * std::f64::consts::PI)
}

/// Corners of the board with normal errors.
pub(crate) fn view(camera_from_board: &Transform, noise_px: f64, random: &mut Random) -> BoardView {
    let intrinsics = intrinsics();
    let points = board_points()
        .into_iter()
        .filter_map(|point_in_board| {
            let pixel =
                intrinsics.project(&(camera_from_board * Point3::from(point_in_board)).coords)?;
            let pixel = [
                pixel[0] + noise_px * random.normal(),
                pixel[1] + noise_px * random.normal(),
            ];
            Some(BoardPoint {
                point_in_board,
                pixel,
            })
        })
        .collect();
    BoardView {
        name: "view".to_owned(),
        points,
    }
}

/// A simulated calibration.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    pub(crate) setup: Setup,
    /// Truth.
    pub(crate) parent_from_camera: Transform,
    pub(crate) parent_from_board: Transform,
    /// True robot poses.
    pub(crate) base_from_flange: Vec<Transform>,
}

/// Errors of simulated measurements.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Errors {
    pub(crate) corner_px: f64,
    pub(crate) robot_rad: f64,
    pub(crate) robot_m: f64,
    /// Errors of given board poses.
    pub(crate) board_rad: f64,
    pub(crate) board_m: f64,
}

impl Scene {
    /// Poses around a board at 0.5 m, rotated about random axes by normal angles with a deviation
    /// of `spread_rad`.
    pub(crate) fn new(setup: Setup, n: usize, spread_rad: f64, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let parent_from_camera = match setup {
            Setup::EyeInHand => Transform::new(
                Vector3::new(0.05, -0.03, 0.08),
                Vector3::new(0.1, -0.2, 1.6),
            ),
            Setup::EyeToHand => {
                Transform::new(Vector3::new(1.0, 0.2, 0.5), Vector3::new(-1.2, 1.2, 1.2))
            }
        };
        let parent_from_board = match setup {
            Setup::EyeInHand => {
                Transform::new(Vector3::new(0.6, 0.1, 0.02), Vector3::new(3.0, 0.1, -0.2))
            }
            Setup::EyeToHand => {
                Transform::new(Vector3::new(0.02, -0.04, 0.1), Vector3::new(0.2, 0.3, -0.4))
            }
        };
        let center = board_points().iter().sum::<Vector3<f64>>() / f64::from(N_COLUMNS * N_ROWS);
        let base_from_flange = (0..n)
            .map(|_| {
                let mut vector = |scale: f64| {
                    Vector3::new(random.normal(), random.normal(), random.normal()) * scale
                };
                // The center of the board stays near the optical axis; the tilt stays below 60
                // degrees.
                let mut turn = vector(spread_rad);
                turn.x = turn.x.clamp(-1.0, 1.0);
                turn.y = turn.y.clamp(-1.0, 1.0);
                let rotation = UnitQuaternion::from_scaled_axis(turn);
                let at = Vector3::new(0.0, 0.0, 0.5) + vector(0.03);
                let camera_from_board =
                    Transform::from_parts((at - rotation * center).into(), rotation);
                match setup {
                    Setup::EyeInHand => {
                        parent_from_board
                            * camera_from_board.inverse()
                            * parent_from_camera.inverse()
                    }
                    Setup::EyeToHand => {
                        parent_from_camera * camera_from_board * parent_from_board.inverse()
                    }
                }
            })
            .collect();
        Self {
            setup,
            parent_from_camera,
            parent_from_board,
            base_from_flange,
        }
    }

    pub(crate) fn camera_from_board(&self, base_from_flange: &Transform) -> Transform {
        match self.setup {
            Setup::EyeInHand => {
                self.parent_from_camera.inverse()
                    * base_from_flange.inverse()
                    * self.parent_from_board
            }
            Setup::EyeToHand => {
                self.parent_from_camera.inverse() * base_from_flange * self.parent_from_board
            }
        }
    }

    fn samples(
        &self,
        errors: &Errors,
        seed: u64,
        board: impl Fn(&Transform, &mut Random) -> BoardObservation,
    ) -> Vec<HandEyeSample> {
        let mut random = Random::new(seed);
        self.base_from_flange
            .iter()
            .enumerate()
            .map(|(ix, pose)| {
                let error = small(&mut random, errors.robot_rad, errors.robot_m);
                let board = board(&self.camera_from_board(pose), &mut random);
                HandEyeSample {
                    name: format!("{ix:02}"),
                    base_from_flange: pose * error,
                    board,
                    joints: None,
                }
            })
            .collect()
    }

    /// Samples with corners.
    pub(crate) fn views(&self, errors: &Errors, seed: u64) -> Vec<HandEyeSample> {
        self.samples(errors, seed, |pose, random| {
            BoardObservation::View(view(pose, errors.corner_px, random))
        })
    }

    /// Samples with board poses.
    pub(crate) fn poses(&self, errors: &Errors, seed: u64) -> Vec<HandEyeSample> {
        self.samples(errors, seed, |pose, random| {
            let error = small(random, errors.board_rad, errors.board_m);
            let rotation = error.rotation * pose.rotation;
            BoardObservation::Pose(Transform::from_parts(
                (pose.translation.vector + error.translation.vector).into(),
                rotation,
            ))
        })
    }

    pub(crate) fn input(&self, samples: Vec<HandEyeSample>) -> HandEyeInput<'static> {
        let has_views = samples
            .iter()
            .any(|sample| matches!(sample.board, BoardObservation::View(_)));
        HandEyeInput {
            setup: self.setup,
            samples,
            intrinsics: has_views.then(intrinsics),
            intrinsics_covariance: None,
            board_symmetries: &[],
            chain: None,
            options: HandEyeOptions::default(),
        }
    }
}

fn small(random: &mut Random, rad: f64, m: f64) -> Transform {
    let mut vector =
        |scale: f64| Vector3::new(random.normal(), random.normal(), random.normal()) * scale;
    Transform::new(vector(m), vector(rad))
}
