//! Emulates the devices of a recorded rig on the wire. These are a controller of a Franka arm or of
//! Universal Robots, motors on CAN buses, servos on a serial bus, and senders of datagrams.
//!
//! A [`DeviceScript`] holds the samples of a simulated or recorded rig. [`PlaybackClock`] maps
//! their stamps to playback times. Images are not played back here. To play back images, use a file
//! of the camera vendor's library.

#[cfg(target_os = "linux")]
mod can;
#[cfg(target_os = "linux")]
mod fci;
#[cfg(target_os = "linux")]
mod servos;
mod udp;
#[cfg(target_os = "linux")]
mod ur;

#[cfg(target_os = "linux")]
pub use can::EmulatedMotors;
#[cfg(target_os = "linux")]
pub use fci::emulate_fci;
#[cfg(target_os = "linux")]
pub use servos::emulate_servos;
pub use udp::{DatagramTargets, EmulatedSenders};
#[cfg(target_os = "linux")]
pub use ur::emulate_ur;

use drivers::{BasePose, RangeScan, Sample};
use kinematics::{HistoryError, JointHistory, JointState, Stamp};
use std::time::Duration;

/// Joint readings are not interpolated across longer gaps.
const MAX_GAP: Duration = Duration::from_secs(1);

/// Samples of all devices of a rig except cameras, each list in stamp order.
#[derive(Clone, Debug, Default)]
pub struct DeviceScript {
    /// Joint readings.
    pub joints: Vec<JointState>,
    /// Poses of the base.
    pub poses: Vec<BasePose>,
    /// Scanner revolutions.
    pub scans: Vec<RangeScan>,
}

impl DeviceScript {
    /// Adds a sample. Ignores images and ground truth.
    pub fn take(&mut self, sample: Sample) {
        match sample {
            Sample::Joints(state) => self.joints.push(state),
            Sample::Base(pose) => self.poses.push(pose),
            Sample::Range(scan) => self.scans.push(scan),
            Sample::Image(_) | Sample::Truth(_) | Sample::BaseTruth(_) => {}
        }
    }
}

/// Time mapping between a script and its playback.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlaybackClock {
    /// An instant of the script.
    pub scripted: Stamp,
    /// The playback time of the same instant, on the monotonic clock.
    pub emulated: Stamp,
}

impl PlaybackClock {
    /// The instant of the script played back at `now`.
    pub fn script_stamp_at(&self, now: Stamp) -> Stamp {
        Stamp(
            now.0
                .saturating_sub(self.emulated.0)
                .saturating_add(self.scripted.0),
        )
    }

    /// The playback time of an instant of the script.
    pub fn playback_stamp_of(&self, scripted: Stamp) -> Stamp {
        Stamp(
            scripted
                .0
                .saturating_sub(self.scripted.0)
                .saturating_add(self.emulated.0),
        )
    }
}

/// Motion of the joints. The joints rest at the first position before the script, and at the last
/// position after it.
#[derive(Clone, Debug)]
pub struct JointTrack {
    history: JointHistory,
    end_states: [JointState; 2],
    playback_clock: PlaybackClock,
}

impl JointTrack {
    /// Fails if readings are out of order or non-finite, or if the script is empty.
    pub fn new(
        readings: &[JointState],
        playback_clock: PlaybackClock,
    ) -> Result<Self, HistoryError> {
        let (Some(first), Some(last)) = (readings.first(), readings.last()) else {
            return Err(HistoryError::NotYet {
                newest: None,
                requested: playback_clock.scripted,
            });
        };
        // The history holds the whole script, because it may be played from any instant.
        let mut history = JointHistory::new(MAX_GAP, readings.len().max(2));
        readings
            .iter()
            .try_for_each(|state| history.push(state.clone()))?;
        let at_rest = |state: &JointState| JointState {
            velocity: vec![0.0; state.position.len()],
            ..state.clone()
        };
        Ok(Self {
            history,
            end_states: [at_rest(first), at_rest(last)],
            playback_clock,
        })
    }

    /// Joints that rest at a position.
    pub fn at_rest(position: Vec<f64>) -> Result<Self, HistoryError> {
        let velocity = vec![0.0; position.len()];
        let state = JointState {
            stamp: Stamp::default(),
            position,
            velocity,
            effort: Vec::new(),
        };
        Self::new(
            &[state],
            PlaybackClock {
                scripted: Stamp::default(),
                emulated: Stamp::default(),
            },
        )
    }

    /// The joints at playback time `now`, which is the stamp of the result.
    pub fn at(&self, now: Stamp) -> JointState {
        let [first, last] = &self.end_states;
        let scripted = self.playback_clock.script_stamp_at(now);
        let state = match self.history.at(scripted) {
            Ok(state) => state,
            Err(_) if scripted < first.stamp => first.clone(),
            // The time is after the end or in a gap. Simulated scripts have no gaps.
            Err(_) => last.clone(),
        };
        JointState {
            stamp: now,
            ..state
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_follow_script_and_rest_outside_it() {
        let reading = |millis: i64| JointState {
            stamp: Stamp(millis * 1_000_000),
            position: vec![0.5 * millis as f64 * 1e-3],
            velocity: vec![0.5],
            effort: vec![],
        };
        let readings: Vec<_> = (100..=200).step_by(10).map(reading).collect();
        let playback_clock = PlaybackClock {
            scripted: Stamp(100_000_000),
            emulated: Stamp(7_000_000_000),
        };
        let track = JointTrack::new(&readings, playback_clock).unwrap();
        let at = |millis: i64| track.at(Stamp(7_000_000_000 + millis * 1_000_000));
        assert_eq!(
            (&at(-50).position[..], &at(-50).velocity[..]),
            (&[0.05][..], &[0.0][..])
        );
        assert!((at(33).position[0] - 0.0665).abs() < 1e-12);
        assert!((at(33).velocity[0] - 0.5).abs() < 1e-9);
        assert_eq!(
            (&at(500).position[..], &at(500).velocity[..]),
            (&[0.1][..], &[0.0][..])
        );
        assert_eq!(
            at(33).stamp,
            Stamp(7_033_000_000),
            "stamped with the playback time"
        );
        assert_eq!(
            playback_clock.script_stamp_at(playback_clock.playback_stamp_of(Stamp(123))),
            Stamp(123)
        );
        assert!(JointTrack::new(&[], playback_clock).is_err());
    }
}
