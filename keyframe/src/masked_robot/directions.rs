//! Directions that are distributed over the sphere.

use nalgebra::Vector3;
use std::f64::consts::{FRAC_PI_2, TAU};

/// Angle between neighboring directions around an axis and along it, radians.
pub const DIRECTION_STEP_RAD: f64 = TAU / 12.0;
/// Number of directions around the axis, and of rings between the poles.
const N_AROUND: u32 = 12;
const N_RINGS: u32 = 5;

/// Unit vectors that are distributed over the sphere: both poles of the z axis, and rings between
/// them. Neighbors form cells that are at most as large as squares with the side
/// [`DIRECTION_STEP_RAD`]. The angle from any direction to the nearest vector is therefore at most
/// half the diagonal of such a square.
pub fn directions() -> Vec<Vector3<f64>> {
    let rings = (1..=N_RINGS).map(|ring| f64::from(ring) * DIRECTION_STEP_RAD - FRAC_PI_2);
    let on_rings = rings.flat_map(|elevation_rad| {
        let (z, radius) = elevation_rad.sin_cos();
        (0..N_AROUND).map(move |ix| {
            let (sin, cos) = (f64::from(ix) * DIRECTION_STEP_RAD).sin_cos();
            Vector3::new(radius * cos, radius * sin, z)
        })
    });
    [-Vector3::z(), Vector3::z()]
        .into_iter()
        .chain(on_rings)
        .collect()
}
