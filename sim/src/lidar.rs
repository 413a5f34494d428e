//! A rotating range scanner. Each ray is cast from the scanner's pose at the time of the ray.
#![expect(
    clippy::cast_possible_truncation,
    reason = "points are in f32, and times within a revolution fit a u32"
)]

use crate::Error;
use crate::config::ScannerConfig;
use crate::random::RandomStream;
use crate::scene::ARM_GROUP;
use drivers::RangePoint;
use kinematics::Transform;
use mujoco_rs::prelude::{MjData, MjModel};
use nalgebra::Vector3;
use std::sync::Arc;

/// The static scene for ray casting. Rays do not hit the robot or glass.
pub(crate) struct RayCaster {
    data: MjData<Arc<MjModel>>,
}

/// Geometry groups that rays hit, which are all groups except the robot and glass.
fn visible_groups() -> [u8; 6] {
    let mut groups = [1; 6];
    groups[ARM_GROUP] = 0;
    groups[crate::scene::GLASS_GROUP] = 0;
    groups
}

impl RayCaster {
    pub(crate) fn new(model: Arc<MjModel>) -> Self {
        let mut data = MjData::new(model);
        data.forward();
        Self { data }
    }

    /// Distances along unit vectors from one point, meters. `None` if a ray hits nothing within
    /// `max_distance_m`.
    fn cast(
        &mut self,
        from: &Vector3<f64>,
        towards: &[[f64; 3]],
        max_distance_m: f64,
    ) -> Result<Vec<Option<f64>>, Error> {
        let origin = [from.x, from.y, from.z];
        let groups = visible_groups();
        let (_, distances) = self
            .data
            .try_multi_ray(
                &origin,
                towards,
                Some(&groups),
                true,
                None,
                max_distance_m,
                None,
            )
            .map_err(|error| Error::Rays {
                reason: error.to_string(),
            })?;
        Ok(distances
            .into_iter()
            .map(|distance| (distance >= 0.0).then_some(distance))
            .collect())
    }
}

/// Scans one revolution. `world_from_base` returns the base pose at a time in nanoseconds after the
/// start of the revolution.
pub(crate) fn scan_revolution(
    rays: &mut RayCaster,
    scanner: &ScannerConfig,
    ideal: bool,
    random: RandomStream,
    world_from_base: impl Fn(i64) -> Transform,
) -> Result<Vec<RangePoint>, Error> {
    let period_nanos = 1e9 / scanner.rate_hz;
    let [lowest, highest] = scanner.elevation_rad;
    let elevation_step = if scanner.n_rings > 1 {
        (highest - lowest) / f64::from(scanner.n_rings - 1)
    } else {
        0.0
    };
    let mut points = Vec::new();
    for column in 0..scanner.n_columns {
        let share = f64::from(column) / f64::from(scanner.n_columns);
        // The time offset of a point is stored in whole microseconds. It is rounded before the pose
        // is computed, so that a receiver that uses the offset gets exactly this pose.
        let offset_micros = (share * period_nanos * 1e-3) as u32;
        let world_from_scanner =
            world_from_base(i64::from(offset_micros) * 1000) * scanner.base_from_scanner;
        let (sin, cos) = (share * std::f64::consts::TAU).sin_cos();
        let directions: Vec<Vector3<f64>> = (0..scanner.n_rings)
            .map(|ring| {
                let (up, flat) = (lowest + elevation_step * f64::from(ring)).sin_cos();
                Vector3::new(flat * cos, flat * sin, up)
            })
            .collect();
        let in_world: Vec<[f64; 3]> = directions
            .iter()
            .map(|direction| (world_from_scanner.rotation * direction).into())
            .collect();
        let distances = rays.cast(
            &world_from_scanner.translation.vector,
            &in_world,
            scanner.max_m,
        )?;
        for (ring, (direction, distance_m)) in directions.iter().zip(distances).enumerate() {
            // Each ray has two random counters, one for its loss and one for its noise. The
            // settings of the loss therefore do not change the noise, and the settings of the noise
            // do not change the loss.
            let counter = u64::from(column) * u64::from(scanner.n_rings) + ring as u64;
            let Some(true_m) = distance_m else { continue };
            let is_dropped = !ideal && random.unit(2 * counter) < scanner.dropped_frac;
            let noise = if ideal {
                0.0
            } else {
                f64::from(random.normals(2 * counter + 1)[0])
            };
            let range_m = true_m + scanner.noise_sigma_m * noise;
            if is_dropped || range_m < scanner.min_m || range_m > scanner.max_m {
                continue;
            }
            let position_m = (direction * range_m).map(|meters| meters as f32).into();
            points.push(RangePoint {
                position_m,
                ring: ring as u16,
                offset_micros,
            });
        }
    }
    Ok(points)
}
