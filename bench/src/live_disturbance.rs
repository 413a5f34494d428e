//! Disturbances of live runs.

use crate::disturb::{Disturbance, expose, exposure_table};
use capture::Rig;
use capture::config::TimeOffset;
use kinematics::Stamp;
use serde::Serialize;
use session::KeyframeChange;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

/// A disturbance of a live run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LiveDisturbance {
    /// Kind of the disturbance, except [`Disturbance::Keyframes`].
    #[serde(serialize_with = "serialize_name")]
    pub disturbance: Disturbance,
    /// Size, in the unit of the kind.
    pub level: f64,
}

impl LiveDisturbance {
    /// Adds a clock offset to the stamps of all cameras.
    pub(crate) fn apply_to_rig(self, rig: &mut Rig) {
        if self.disturbance != Disturbance::ClockOffset {
            return;
        }
        for camera in &mut rig.cameras {
            let unknown = TimeOffset {
                value_millis: 0.0,
                sigma_millis: 0.0,
                source: String::new(),
            };
            camera
                .stamp_to_mid_exposure
                .get_or_insert(unknown)
                .value_millis += self.level;
        }
    }

    /// The change of each keyframe by pose noise or an exposure step. The exposure changes
    /// `step_after_secs` after the first keyframe.
    pub(crate) fn keyframe_change(self, seed: u64, step_after_secs: f64) -> Option<KeyframeChange> {
        match self.disturbance {
            Disturbance::PoseNoise => Some(Box::new(move |keyframe| {
                self.disturbance
                    .apply(&[keyframe], self.level, seed, 1e9)
                    .remove(0)
            })),
            Disturbance::Exposure => {
                // The middle of the capture is not known during a live run, so the time of the step
                // is given.
                let tables =
                    [-0.5, 0.5].map(|fraction| exposure_table(2.0_f64.powf(fraction * self.level)));
                let mut step_at: Option<Stamp> = None;
                Some(Box::new(move |keyframe| {
                    // The time of the step is relative to the first keyframe, because stamps of a
                    // recording are not times of this run.
                    let step_at = *step_at.get_or_insert(keyframe.stamp.plus_secs(step_after_secs));
                    let mut changed = keyframe.as_ref().clone();
                    expose(
                        &mut changed,
                        &tables[usize::from(keyframe.stamp >= step_at)],
                    );
                    Arc::new(changed)
                }))
            }
            Disturbance::ClockOffset | Disturbance::Keyframes => None,
        }
    }
}

/// A text is not a disturbance of a live run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "must be pose-noise:MM up to 1000, clock-offset:MS up to 500 or exposure:EV up to 10, such as exposure:0.5"
)]
pub struct InvalidDisturbance;

impl FromStr for LiveDisturbance {
    type Err = InvalidDisturbance;

    /// Reads a name and a size, such as `exposure:0.5`.
    fn from_str(text: &str) -> Result<Self, InvalidDisturbance> {
        let (name, level) = text.split_once(':').ok_or(InvalidDisturbance)?;
        let disturbance = Disturbance::ALL
            .into_iter()
            .find(|disturbance| disturbance.name() == name.trim())
            .ok_or(InvalidDisturbance)?;
        let max = match disturbance {
            Disturbance::PoseNoise => 1000.0,
            Disturbance::ClockOffset => 500.0,
            Disturbance::Exposure => 10.0,
            // A live run has no fixed number of keyframes.
            Disturbance::Keyframes => return Err(InvalidDisturbance),
        };
        let level = level.trim().parse().map_err(|_| InvalidDisturbance)?;
        if !(0.0..=max).contains(&level) {
            return Err(InvalidDisturbance);
        }
        Ok(Self { disturbance, level })
    }
}

impl fmt::Display for LiveDisturbance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} {} {}",
            self.disturbance.name(),
            self.level,
            self.disturbance.unit()
        )
    }
}

fn serialize_name<S: serde::Serializer>(
    disturbance: &Disturbance,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(disturbance.name())
}

#[cfg(test)]
mod tests {
    use super::*;
    use keyframe::{Keyframe, Split};

    fn keyframe(secs: f64, split: Split) -> Arc<Keyframe> {
        let first = crate::disturb::tests::capture(1).remove(0);
        Arc::new(Keyframe {
            stamp: Stamp(0).plus_secs(secs),
            split,
            ..first.as_ref().clone()
        })
    }

    #[test]
    fn clock_offset_shifts_all_stamps() {
        let path =
            std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/two-cameras.toml");
        let rig = Rig::load(&path, &[]).expect("a bundled rig file");
        let mut shifted = rig.clone();
        LiveDisturbance {
            disturbance: Disturbance::ClockOffset,
            level: 20.0,
        }
        .apply_to_rig(&mut shifted);
        let offset_of = |rig: &Rig, ix: usize| {
            rig.cameras[ix]
                .stamp_to_mid_exposure
                .as_ref()
                .map_or(0.0, |offset| offset.value_millis)
        };
        assert!((0..2).all(|ix| offset_of(&shifted, ix) == offset_of(&rig, ix) + 20.0));
        LiveDisturbance {
            disturbance: Disturbance::PoseNoise,
            level: 20.0,
        }
        .apply_to_rig(&mut shifted);
        assert_eq!(offset_of(&shifted, 0), offset_of(&rig, 0) + 20.0);
    }

    #[test]
    fn exposure_steps_at_a_time_and_pose_noise_spares_test_images() {
        let exposure = LiveDisturbance {
            disturbance: Disturbance::Exposure,
            level: 1.0,
        };
        let mut change = exposure.keyframe_change(1, 2.0).expect("changes keyframes");
        let before = keyframe(0.0, Split::Train).rgba_srgb[1];
        let mut green_at = |secs: f64| change(keyframe(secs, Split::Train)).rgba_srgb[1];
        let greens = [green_at(0.0), green_at(1.9), green_at(2.1)];
        assert!(
            greens[0] < before && greens[1] == greens[0] && greens[2] > before,
            "{before} {greens:?}"
        );

        let noise = LiveDisturbance {
            disturbance: Disturbance::PoseNoise,
            level: 1.0,
        };
        let mut change = noise.keyframe_change(1, 2.0).expect("changes keyframes");
        let mut moved = |secs: f64, split: Split| {
            let given = keyframe(secs, split);
            let noisy = change(Arc::clone(&given));
            (given.world_from_camera.inverse() * noisy.world_from_camera)
                .translation
                .vector
                .norm()
        };
        assert!((1e-4..5e-3).contains(&moved(0.0, Split::Train)));
        assert_eq!(moved(0.0, Split::Test), 0.0);
        assert_ne!(moved(0.0, Split::Train), moved(0.1, Split::Train));
    }
}
