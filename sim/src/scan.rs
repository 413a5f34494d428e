//! The camera tour around the target area on the table.

use crate::objects::{TABLE_Z_M, TARGET_XY_M};
use kinematics::Transform;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::TAU;

/// The tour around the target area.
///
/// Azimuth, elevation, distance, roll and look-at point oscillate with periods that have no common
/// multiple. The first seconds therefore cover the whole range coarsely, and later seconds fill the
/// gaps. Every quantity moves in both directions at continuously changing speed. A time offset and
/// a hand-eye error therefore have different effects.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scan {
    speed: f64,
    is_azimuth_only: bool,
    shape: ScanShape,
}

/// Ranges of the tour as seen from the target area. The default is the tour of the static arm.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ScanShape {
    /// Direction of the camera about the vertical axis. A direction of 0 is toward the robot.
    pub(crate) azimuth_degrees: Oscillation,
    /// Direction of the camera above the horizontal.
    pub(crate) elevation_degrees: Oscillation,
    /// Distance of the camera from the look-at point.
    pub(crate) distance_m: Oscillation,
}

impl Default for ScanShape {
    fn default() -> Self {
        Self {
            azimuth_degrees: AZIMUTH_DEGREES,
            elevation_degrees: ELEVATION_DEGREES,
            distance_m: DISTANCE_M,
        }
    }
}

/// One oscillating quantity, given by its mean, amplitude, period in seconds at speed 1, and phase
/// in turns.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Oscillation(f64, f64, f64, f64);

impl Oscillation {
    /// This oscillation with another mean and another amplitude.
    pub(crate) fn over(&self, mean: f64, amplitude: f64) -> Self {
        Self(mean, amplitude, self.2, self.3)
    }

    fn at(&self, secs: f64) -> f64 {
        let Self(mean, amplitude, period_secs, phase) = self;
        mean + amplitude * ((secs / period_secs + phase) * TAU).sin()
    }
}

const AZIMUTH_DEGREES: Oscillation = Oscillation(0.0, 45.0, 11.3, -0.20);
const ELEVATION_DEGREES: Oscillation = Oscillation(40.0, 20.0, 7.1, 0.35);
const DISTANCE_M: Oscillation = Oscillation(0.35, 0.10, 9.2, 0.10);
const ROLL_DEGREES: Oscillation = Oscillation(0.0, 20.0, 8.3, 0.60);
const LOOK_AT_X_M: Oscillation = Oscillation(0.0, 0.03, 6.3, 0.0);
const LOOK_AT_Y_M: Oscillation = Oscillation(0.0, 0.04, 7.7, 0.5);
/// Height of the look-at point above the table, meters.
pub(crate) const LOOK_AT_HEIGHT_M: f64 = 0.06;
/// The motion accelerates from rest within this time, seconds.
const START_SECS: f64 = 0.5;
/// The speed varies by this fraction, with this period in seconds.
const SPEED_OSCILLATION: (f64, f64) = (0.35, 4.9);

impl Scan {
    /// With `is_azimuth_only`, all quantities except the azimuth stay at their means. The camera
    /// then rotates about one axis.
    pub(crate) fn new(speed: f64, is_azimuth_only: bool) -> Self {
        Self {
            speed,
            is_azimuth_only,
            shape: ScanShape::default(),
        }
    }

    /// This tour with another shape.
    pub(crate) fn with_shape(self, shape: ScanShape) -> Self {
        Self { shape, ..self }
    }

    /// This tour at another speed.
    pub(crate) fn with_speed(self, speed: f64) -> Self {
        Self { speed, ..self }
    }

    pub(crate) fn speed(&self) -> f64 {
        self.speed
    }

    fn oscillation(&self, oscillation: &Oscillation, at: f64) -> f64 {
        if self.is_azimuth_only {
            oscillation.0
        } else {
            oscillation.at(at)
        }
    }

    /// Progress along the tour, in seconds at constant speed. The motion starts at rest.
    fn progress(&self, secs: f64) -> f64 {
        let (share, period_secs) = SPEED_OSCILLATION;
        // This is the integral of a smooth ramp from 0 to 1.
        let ramp = (secs / START_SECS).clamp(0.0, 1.0);
        let started =
            START_SECS * (ramp.powi(3) - 0.5 * ramp.powi(4)) + (secs - START_SECS).max(0.0);
        let uniform_secs = started * self.speed;
        // This is the integral of a speed that oscillates about 1. Its derivative is continuous at
        // the start, where the cosine has zero derivative.
        uniform_secs + share * period_secs / TAU * (1.0 - (uniform_secs * TAU / period_secs).cos())
    }

    /// The point that the camera looks at.
    pub(crate) fn look_at(&self, secs: f64) -> Vector3<f64> {
        self.look_at_after(self.progress(secs))
    }

    fn look_at_after(&self, at: f64) -> Vector3<f64> {
        let [look_at_x_m, look_at_y_m] =
            [&LOOK_AT_X_M, &LOOK_AT_Y_M].map(|oscillation| self.oscillation(oscillation, at));
        Vector3::new(
            TARGET_XY_M[0] + look_at_x_m,
            TARGET_XY_M[1] + look_at_y_m,
            TABLE_Z_M + LOOK_AT_HEIGHT_M,
        )
    }

    /// Roll of the camera about its optical axis, radians.
    pub(crate) fn roll_rad(&self, secs: f64) -> f64 {
        self.oscillation(&ROLL_DEGREES, self.progress(secs))
            .to_radians()
    }

    /// Target pose of the camera. Its axes are x right, y down, and z toward the look-at point.
    pub(crate) fn world_from_camera(&self, secs: f64) -> Transform {
        let at = self.progress(secs);
        let azimuth = self.shape.azimuth_degrees.at(at).to_radians();
        let elevation = self
            .oscillation(&self.shape.elevation_degrees, at)
            .to_radians();
        let target = self.look_at_after(at);
        let back = Vector3::new(
            -elevation.cos() * azimuth.cos(),
            -elevation.cos() * azimuth.sin(),
            elevation.sin(),
        );
        let upright = looking_along(&-back);
        let roll = UnitQuaternion::from_axis_angle(
            &Vector3::z_axis(),
            self.oscillation(&ROLL_DEGREES, at).to_radians(),
        );
        Transform::from_parts(
            Translation3::from(target + back * self.oscillation(&self.shape.distance_m, at)),
            upright * roll,
        )
    }
}

/// Orientation of an upright camera that looks along a direction. The axes of the camera are x
/// right, y down, z forward.
pub(crate) fn looking_along(forward: &Vector3<f64>) -> UnitQuaternion<f64> {
    let right = forward.cross(&Vector3::z()).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), *forward]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes))
}
