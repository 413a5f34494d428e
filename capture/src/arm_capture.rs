//! Moves an arm in small steps and takes images while it stands still.

use crate::calibration_images::{ArmDuringImage, CalibrationImage, gray_of};
use crate::config::{Camera, Rig};
use crate::open::{Movable, chain_of};
use crate::stop::Stop;
use crate::supervised_arm::SupervisedArm;
use drivers::Image;
use drivers::motion::JointTarget;
use keyframe::bail;
use kinematics::{Chain, JointState, Stamp};
use std::collections::VecDeque;
use std::time::Duration;

/// Largest change of a joint in one step, radians or meters.
const MAX_STEP: f64 = 0.25;
/// Time before an image during which the arm must stand still: longer than stamps are wrong and mounts vibrate.
const SETTLE_SECS: f64 = 0.3;
/// Largest drift of a joint during that time, radians or meters: the difference between the means of both halves, which
/// averages the noise of encoders.
const MAX_DRIFT: f64 = 3e-4;
/// Maximum time until the arm stands still and an image arrives.
const MAX_WAIT_SECS: f64 = 15.0;
/// Largest distance of a joint from its target after a motion, radians or meters. Arms without gravity compensation sag.
const MAX_ERROR: f64 = 0.1;
/// Duration of one wait for an image.
const POLL: Duration = Duration::from_millis(20);
/// Number of joint states kept: those of a second at 1 kHz.
const MAX_STATES: usize = 1000;

/// A camera and a movable arm.
pub struct ArmCapture {
    rig: Rig,
    chain: Chain,
    /// Index in the joint states of each joint of the chain.
    order: Vec<usize>,
    arm: SupervisedArm,
    camera: Box<dyn drivers::Camera>,
    recent: VecDeque<JointState>,
    first: Option<Stamp>,
}

impl ArmCapture {
    /// Takes over opened devices.
    ///
    /// # Errors
    /// If the robot description does not match the rig.
    pub fn new(movable: Movable) -> crate::Result<Self> {
        let Movable { rig, arm, camera } = movable;
        let chain = chain_of(&rig)?;
        let order = chain.order_in(&rig.arm.joints)?;
        let arm = SupervisedArm::new(arm, &rig);
        Ok(Self { rig, chain, order, arm, camera, recent: VecDeque::new(), first: None })
    }

    /// The rig, with the calibration that its devices report.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The kinematics of the arm.
    pub fn chain(&self) -> &Chain {
        &self.chain
    }

    fn camera(&self) -> &Camera {
        &self.rig.cameras[0]
    }

    /// The joints now, in the order of the chain.
    ///
    /// # Errors
    /// If the arm has stopped or reports nothing.
    pub fn joints(&mut self) -> crate::Result<Vec<f64>> {
        let state = self.read()?;
        Ok(self.in_chain_order(&state.position))
    }

    /// Moves to joint values in the order of the chain, in steps. Returns false if a stop was requested; the arm then stands
    /// still.
    ///
    /// # Errors
    /// If the arm stops because of a fault, or does not reach a step.
    pub fn move_to(&mut self, joints: &[f64], stop: &Stop) -> crate::Result<bool> {
        let from = self.joints()?;
        let largest = from.iter().zip(joints).map(|(from, to)| (to - from).abs()).fold(0.0, f64::max);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "joints move by a few radians")]
        let n_steps = (largest / MAX_STEP).ceil().clamp(1.0, 1000.0) as u32;
        for step in 1..=n_steps {
            if stop.requested() {
                return Ok(false);
            }
            let share = f64::from(step) / f64::from(n_steps);
            let waypoint = from.iter().zip(joints).map(|(from, to)| from + share * (to - from));
            if !self.step_to(&waypoint.collect::<Vec<_>>(), stop)? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn step_to(&mut self, joints: &[f64], stop: &Stop) -> crate::Result<bool> {
        // Joints that do not move the camera stay where they are.
        let mut target = JointTarget { position: self.read()?.position };
        for (value, ix) in joints.iter().zip(&self.order) {
            target.position[*ix] = *value;
        }
        let target = self.arm.command(&target)?;
        let recent = &mut self.recent;
        let end = self.arm.follow(stop, |state| remember(recent, state))?;
        if !end.has_arrived {
            return Ok(false);
        }
        let errors = end.state.position.iter().zip(&target.position).map(|(actual, target)| (actual - target).abs());
        let (ix, error) = errors.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or_default();
        if error > MAX_ERROR {
            let joint = &self.rig.arm.joints[ix];
            bail!(
                "joint {joint:?} is {error:.3} rad from its target of {:.3} after a motion (at most {MAX_ERROR}); check for an obstacle, or raise its stiffness",
                target.position[ix]
            );
        }
        Ok(true)
    }

    /// Waits until the arm stands still, and returns the next image exposed from then on, with the mean of the joints.
    /// `None` if a stop was requested.
    ///
    /// # Errors
    /// If a device fails, the arm does not come to rest, or no image can be decoded.
    pub fn image(&mut self, stop: &Stop) -> crate::Result<Option<CalibrationImage>> {
        let began = self.read()?.stamp;
        self.first.get_or_insert(began);
        loop {
            if stop.requested() {
                return Ok(None);
            }
            // Notices faults, and ends the wait if no image is usable.
            let now = self.read()?.stamp;
            self.check_wait(began, now)?;
            let image = match self.camera.next_image(POLL) {
                Ok(image) => image,
                Err(
                    drivers::Error::NoImage { .. }
                    | drivers::Error::Reconnecting { .. }
                    | drivers::Error::NotDue { .. },
                ) => continue,
                Err(error) => return Err(error.into()),
            };
            let [start, end] = self.exposure(&image);
            let settling = start.plus_secs(-SETTLE_SECS);
            // Queued images may be from before the motion.
            if image.is_depth() || settling < began {
                continue;
            }
            while self.recent.back().is_none_or(|newest| newest.stamp < end) {
                let now = self.read()?.stamp;
                self.check_wait(began, now)?;
            }
            let Some(joints) = self.joints_at_rest(settling, end) else { continue };
            let Some(gray) = gray_of(&image) else { continue };
            let pose = self.chain.forward(&joints)?;
            return Ok(Some(CalibrationImage {
                secs: self.first.map_or(0.0, |first| image.stamp.secs_since(first)),
                size_px: image.size_px,
                gray,
                arm: Some(ArmDuringImage { base_from_flange: pose, base_from_flange_at_rows: [pose; 2], joints }),
            }));
        }
    }

    fn check_wait(&self, began: Stamp, now: Stamp) -> crate::Result<()> {
        if now.secs_since(began) > MAX_WAIT_SECS {
            let camera = &self.camera().name;
            bail!(
                "camera {camera:?}: no image with the arm at rest within {MAX_WAIT_SECS} s; check that the camera delivers images, and that its stamps and those of the arm are on the same clock"
            );
        }
        Ok(())
    }

    /// Time span in which the rows of an image are exposed.
    fn exposure(&self, image: &Image) -> [Stamp; 2] {
        let camera = self.camera();
        let mid = camera.mid_exposure(image.stamp);
        let configured = camera.exposure_micros.map(|micros| 1e-6 * micros);
        let exposure_secs = image.exposure_secs.or(configured).unwrap_or(0.0);
        let half_secs = 0.5 * (1e-6 * camera.readout_micros.unwrap_or(0.0) + exposure_secs);
        [mid.plus_secs(-half_secs), mid.plus_secs(half_secs)]
    }

    /// Mean of the joints over a time span, in the order of the chain. `None` if the states do not cover it, or if a joint
    /// moves.
    fn joints_at_rest(&self, start: Stamp, end: Stamp) -> Option<Vec<f64>> {
        let covers = self.recent.front()?.stamp <= start && self.recent.back()?.stamp >= end;
        let span: Vec<&JointState> = self.recent.iter().filter(|state| (start..=end).contains(&state.stamp)).collect();
        const MIN_STATES: usize = 4;
        if !covers || span.len() < MIN_STATES {
            return None;
        }
        let (early, late) = span.split_at(span.len() / 2);
        let differences = mean(early).into_iter().zip(mean(late)).map(|(early, late)| (early - late).abs());
        (differences.fold(0.0, f64::max) <= MAX_DRIFT).then(|| self.in_chain_order(&mean(&span)))
    }

    fn in_chain_order(&self, position: &[f64]) -> Vec<f64> {
        self.order.iter().map(|ix| position[*ix]).collect()
    }

    fn read(&mut self) -> crate::Result<JointState> {
        let state = self.arm.read()?;
        remember(&mut self.recent, &state);
        Ok(state)
    }

    /// Holds the arm in place until a stop is requested.
    ///
    /// # Errors
    /// If the arm stops because of a fault.
    pub fn hold(&mut self, stop: &Stop) -> crate::Result<()> {
        self.arm.hold(stop, |_| ())
    }
}

/// Mean joint positions.
fn mean(states: &[&JointState]) -> Vec<f64> {
    let n_joints = states.first().map_or(0, |state| state.position.len());
    let of = |ix: usize| states.iter().map(|state| state.position[ix]).sum::<f64>() / states.len() as f64;
    (0..n_joints).map(of).collect()
}

fn remember(recent: &mut VecDeque<JointState>, state: &JointState) {
    if recent.len() >= MAX_STATES {
        recent.pop_front();
    }
    recent.push_back(state.clone());
}
