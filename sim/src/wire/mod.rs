//! Plays what a rig said as its devices would say it, on the wire: a Franka controller, motors on CAN buses, datagrams.
//!
//! A rig that was simulated before is a [`DeviceScript`]; [`PlaybackClock`] says when each instant of it is played. Images are not played
//! here: a recording of the camera's own library is.

#[cfg(target_os = "linux")]
mod can;
#[cfg(target_os = "linux")]
mod fci;
mod udp;

#[cfg(target_os = "linux")]
pub use can::EmulatedMotors;
#[cfg(target_os = "linux")]
pub use fci::emulate_fci;
pub use udp::{DatagramTargets, EmulatedSenders};

use drivers::{BasePose, RangeScan, Sample};
use kinematics::{HistoryError, JointHistory, JointState, Stamp};
use std::time::Duration;

/// Joint readings of a script further apart than this are no motion.
const MAX_GAP: Duration = Duration::from_secs(1);

/// What the devices of a rig said, but for its cameras, each in the order of its stamps.
#[derive(Clone, Debug, Default)]
pub struct DeviceScript {
    /// Joint readings.
    pub joints: Vec<JointState>,
    /// Poses of the base.
    pub poses: Vec<BasePose>,
    /// Turns of scanners.
    pub scans: Vec<RangeScan>,
}

impl DeviceScript {
    /// Takes what is played here; images and truths are not.
    pub fn take(&mut self, sample: Sample) {
        match sample {
            Sample::Joints(state) => self.joints.push(state),
            Sample::Base(pose) => self.poses.push(pose),
            Sample::Range(scan) => self.scans.push(scan),
            Sample::Image(_) | Sample::Truth(_) | Sample::BaseTruth(_) => {}
        }
    }
}

/// When a script is played.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlaybackClock {
    /// An instant of the script.
    pub scripted: Stamp,
    /// When that is, on the monotonic clock.
    pub emulated: Stamp,
}

impl PlaybackClock {
    /// The instant of the script that is played at `now`.
    pub fn script_stamp_at(&self, now: Stamp) -> Stamp {
        Stamp(now.0.saturating_sub(self.emulated.0).saturating_add(self.scripted.0))
    }

    /// When an instant of the script is played.
    pub fn playback_stamp_of(&self, scripted: Stamp) -> Stamp {
        Stamp(scripted.0.saturating_sub(self.scripted.0).saturating_add(self.emulated.0))
    }
}

/// How joints move; before and after the script they stand still at its ends.
#[derive(Clone, Debug)]
pub struct JointTrack {
    history: JointHistory,
    end_states: [JointState; 2],
    playback_clock: PlaybackClock,
}

impl JointTrack {
    /// Readings out of order, or without numbers, are errors, and so is a script without any.
    pub fn new(readings: &[JointState], playback_clock: PlaybackClock) -> Result<Self, HistoryError> {
        let (Some(first), Some(last)) = (readings.first(), readings.last()) else {
            return Err(HistoryError::NotYet { newest: None, asked: playback_clock.scripted });
        };
        let mut history = JointHistory::new(MAX_GAP, readings.len().max(2));
        readings.iter().try_for_each(|state| history.push(state.clone()))?;
        let at_rest = |state: &JointState| JointState { velocity: vec![0.0; state.position.len()], ..state.clone() };
        Ok(Self { history, end_states: [at_rest(first), at_rest(last)], playback_clock })
    }

    /// The joints as they are played at `now`, which is the stamp of what is returned.
    pub fn at(&self, now: Stamp) -> JointState {
        let [first, last] = &self.end_states;
        let scripted = self.playback_clock.script_stamp_at(now);
        let state = match self.history.at(scripted) {
            Ok(state) => state,
            Err(_) if scripted < first.stamp => first.clone(),
            // Past the end, or in a gap, which a simulation does not leave.
            Err(_) => last.clone(),
        };
        JointState { stamp: now, ..state }
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
        let playback_clock = PlaybackClock { scripted: Stamp(100_000_000), emulated: Stamp(7_000_000_000) };
        let track = JointTrack::new(&readings, playback_clock).unwrap();
        let at = |millis: i64| track.at(Stamp(7_000_000_000 + millis * 1_000_000));
        assert_eq!((&at(-50).position[..], &at(-50).velocity[..]), (&[0.05][..], &[0.0][..]));
        assert!((at(33).position[0] - 0.0665).abs() < 1e-12);
        assert!((at(33).velocity[0] - 0.5).abs() < 1e-9);
        assert_eq!((&at(500).position[..], &at(500).velocity[..]), (&[0.1][..], &[0.0][..]));
        assert_eq!(at(33).stamp, Stamp(7_033_000_000), "stamped when it is played");
        assert_eq!(playback_clock.script_stamp_at(playback_clock.playback_stamp_of(Stamp(123))), Stamp(123));
        assert!(JointTrack::new(&[], playback_clock).is_err());
    }
}
