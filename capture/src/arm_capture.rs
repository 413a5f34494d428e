//! Moves an arm in small steps and takes images while it stands still.

use crate::calibration_images::{ArmDuringImage, CalibrationImage, gray_of};
use crate::config::{Camera, Rig};
use crate::open::{Movable, chain_of};
use crate::stop::Stop;
use crate::supervised_arm::SupervisedArm;
use anyhow::{Context, bail};
use drivers::Image;
use drivers::motion::JointTarget;
use kinematics::{Chain, JointState, Stamp, Transform};
use std::collections::VecDeque;
use std::time::Duration;

/// Largest change of a joint in one step, radians or meters. The position is checked after each
/// step. The step therefore also bounds how far the arm pushes against an obstacle. Smaller steps
/// are safer and slower.
const MAX_STEP: f64 = 0.25;
/// Time before an image during which the arm must stand still. It is longer than the errors of
/// stamps, and longer than a camera mount vibrates.
const SETTLE_SECS: f64 = 0.3;
/// Largest drift of a joint during [`SETTLE_SECS`], radians or meters. The drift is the difference
/// between the mean positions in the two halves of that time. The means average the noise of
/// encoders.
///
/// With a smaller value, arms that sway or have coarse encoders never count as resting. With a
/// larger value, images of a moving camera are accepted. At an arm's length of 1 m, 3e-4 rad is 0.3
/// mm.
const MAX_DRIFT: f64 = 3e-4;
/// Maximum time until the arm stands still and an image arrives, by the stamps of the arm.
const MAX_WAIT_SECS: f64 = 15.0;
/// Largest distance of a joint from its target after a motion, radians or meters. It is also the
/// largest correction of the joint's sag. Arms without gravity compensation sag by their load
/// divided by their stiffness. Larger values let the arm push harder against an obstacle before it
/// retreats.
const MAX_ERROR: f64 = 0.1;
/// The measured flange may be farther from its start by this distance than targets may be, meters.
/// The tolerance allows for sag, which may move each joint by up to [`MAX_ERROR`].
const DISTANCE_TOLERANCE_M: f64 = 0.03;
/// Duration of one wait for an image. It bounds the time until a fault of the arm is noticed.
const POLL: Duration = Duration::from_millis(20);
/// Number of joint states kept. At 1 kHz, they cover a minute, because a slow computer may take
/// this long to render an image of a simulated camera. They take 20 MB.
const MAX_STATES: usize = 60_000;

/// A wait for an image, in the time of the arm. Simulated devices that wait for their caller stand
/// still between reads, and a slow computer delays a simulated camera but not the arm.
struct Wait {
    secs: f64,
    last: Stamp,
    /// Whether a simulation was late when the camera was read. Until the next state, the time does
    /// not count.
    is_simulation_late: bool,
}

impl Wait {
    fn new(began: Stamp) -> Self {
        Self {
            secs: 0.0,
            last: began,
            is_simulation_late: false,
        }
    }

    /// Counts the time until a joint state.
    fn advance(&mut self, now: Stamp) {
        if !std::mem::take(&mut self.is_simulation_late) {
            self.secs += now.secs_since(self.last);
        }
        self.last = now;
    }
}

/// Why the last image was not usable.
enum Seen {
    Nothing,
    Undecodable,
    /// It was exposed this long before the arm was at rest.
    Old {
        secs: f64,
    },
    /// Its exposure ends this long after the newest joint state.
    Early {
        secs: f64,
    },
    FewStates,
    /// A joint moved by this much.
    Drift {
        joint_ix: usize,
        drift: f64,
    },
}

/// A camera and a movable arm.
pub struct ArmCapture {
    rig: Rig,
    chain: Chain,
    /// Index in the joint states of each joint of the chain.
    order: Vec<usize>,
    arm: SupervisedArm,
    /// The last accepted target. Before the first target, it is the first state.
    accepted: Option<Vec<f64>>,
    /// Start pose of the flange, and the distance by which the flange may move away from it,
    /// meters.
    limit: Option<(Transform, f64)>,
    camera: Box<dyn drivers::Camera>,
    recent: VecDeque<JointState>,
    first: Option<Stamp>,
}

impl ArmCapture {
    /// Takes over opened devices.
    ///
    /// # Errors
    /// If the robot description does not match the rig.
    pub fn new(movable: Movable) -> anyhow::Result<Self> {
        let Movable { rig, arm, camera } = movable;
        let chain = chain_of(&rig)?;
        let order = chain.order_in(&rig.arm.joints)?;
        let arm = SupervisedArm::new(arm, &rig);
        Ok(Self {
            rig,
            chain,
            order,
            arm,
            accepted: None,
            limit: None,
            camera,
            recent: VecDeque::new(),
            first: None,
        })
    }

    /// Limits the distance of the flange from its current pose. A motion that exceeds the limit,
    /// for example because the arm sags, is reversed.
    ///
    /// # Errors
    /// If the arm has stopped or reports nothing.
    pub fn limit_distance(&mut self, max_distance_m: f64) -> anyhow::Result<()> {
        let joints = self.joints()?;
        let flange = self.chain.forward(&joints)?;
        self.limit = Some((flange, max_distance_m));
        Ok(())
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
    pub fn joints(&mut self) -> anyhow::Result<Vec<f64>> {
        let state = self.read()?;
        Ok(self.in_chain_order(&state.position))
    }

    /// Moves to joint values in the order of the chain, in steps. Returns false if a stop was
    /// requested. In this case, the arm stands still.
    ///
    /// # Errors
    /// If the arm stops because of a fault, does not reach a step, or exceeds the limit of the
    /// distance. In the last two cases, the arm has returned to the previous step, or holds its
    /// current position.
    pub fn move_to(&mut self, joints: &[f64], stop: &Stop) -> anyhow::Result<bool> {
        let from = self.joints()?;
        let largest = from
            .iter()
            .zip(joints)
            .map(|(from, to)| (to - from).abs())
            .fold(0.0, f64::max);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "joints move by a few radians"
        )]
        let n_steps = (largest / MAX_STEP).ceil().clamp(1.0, 1000.0) as u32;
        for step in 1..=n_steps {
            if stop.requested() {
                return Ok(false);
            }
            // All joints move in proportion, so that the path is a straight line in joint space for
            // any number of steps.
            let share = f64::from(step) / f64::from(n_steps);
            let waypoint = from
                .iter()
                .zip(joints)
                .map(|(from, to)| from + share * (to - from));
            if !self.step_to(&waypoint.collect::<Vec<_>>(), stop)? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn step_to(&mut self, joints: &[f64], stop: &Stop) -> anyhow::Result<bool> {
        let free = self.read()?.position;
        // This command makes the arm stay at its current position. It is the previous target,
        // unless someone has moved the arm since then. The sag of the last step is the best
        // prediction for the next step, because the load changes little within a step. Commanding
        // the target plus the sag brings the joint to the target itself.
        let accepted = self.accepted.get_or_insert_with(|| free.clone());
        let sag = accepted
            .iter()
            .zip(&free)
            .map(|(target, actual)| (target - actual).clamp(-MAX_ERROR, MAX_ERROR));
        let sag: Vec<f64> = sag.collect();
        let stay: Vec<f64> = free
            .iter()
            .zip(&sag)
            .map(|(actual, sag)| actual + sag)
            .collect();
        // Joints that do not move the camera keep their target.
        let mut target = stay.clone();
        let mut expected = free.clone();
        for (value, ix) in joints.iter().zip(&self.order) {
            target[*ix] = value + sag[*ix];
            expected[*ix] = *value;
        }
        let Some(state) = self.go(&target, stop)? else {
            return Ok(false);
        };
        // An arm that is off its target after a motion probably touches something. Continuing would
        // increase the force, so the arm goes back first, and the error follows.
        if let Some(problem) = self.problem(&state, &expected)? {
            let end = self
                .retreat(&stay, &free, stop)
                .with_context(|| problem.clone())?;
            bail!("{problem}; {end}");
        }
        Ok(true)
    }

    /// Moves to positions of all joints. Returns the state at the end, or `None` if a stop was
    /// requested.
    fn go(&mut self, position: &[f64], stop: &Stop) -> anyhow::Result<Option<JointState>> {
        let accepted = self.arm.command(&JointTarget {
            position: position.to_vec(),
        })?;
        self.accepted = Some(accepted.position);
        // Only the field `recent` is borrowed, because the arm is borrowed at the same time.
        let recent = &mut self.recent;
        let end = self.arm.follow(stop, |state| remember(recent, state))?;
        if !end.has_arrived {
            // The arm holds at a position on its way to the target.
            self.accepted = Some(end.state.position);
            return Ok(None);
        }
        Ok(Some(end.state))
    }

    /// The reason why the arm must not continue from a state. `None` if the arm is where it should
    /// be.
    fn problem(&self, state: &JointState, expected: &[f64]) -> anyhow::Result<Option<String>> {
        if let Some((ix, error)) = largest_error(&state.position, expected)
            && error > MAX_ERROR
        {
            let joint = &self.rig.arm.joints[ix];
            return Ok(Some(format!(
                "joint {joint:?} is {error:.3} rad from its target of {:.3} after a motion (at most {MAX_ERROR}); check for an obstacle, or raise its stiffness",
                expected[ix]
            )));
        }
        let Some((start, max_m)) = &self.limit else {
            return Ok(None);
        };
        let flange = self.chain.forward(&self.in_chain_order(&state.position))?;
        let distance_m = (flange.translation.vector - start.translation.vector).norm();
        Ok((distance_m > max_m + DISTANCE_TOLERANCE_M).then(|| {
            format!(
                "the flange is {:.0} mm from its start (at most {:.0} mm) because joints are off their targets; raise their stiffness",
                1e3 * distance_m,
                1e3 * max_m
            )
        }))
    }

    /// Stops pushing against an obstacle: returns to the previous step, which was free, or holds
    /// the arm where it is.
    ///
    /// * `stay`: the command of the previous step.
    /// * `expected`: the position to which `stay` brings the arm.
    fn retreat(
        &mut self,
        stay: &[f64],
        expected: &[f64],
        stop: &Stop,
    ) -> anyhow::Result<&'static str> {
        // The previous step was reached without contact, so the way back to it is free.
        if let Some(state) = self.go(stay, stop)?
            && largest_error(&state.position, expected).is_none_or(|(_, error)| error <= MAX_ERROR)
        {
            return Ok("the arm has returned to the previous step");
        }
        // The current position becomes the target, so that the motors no longer push. A stop
        // request must not prevent this command.
        let here = self.read()?.position;
        self.go(&here, &Stop::default())?;
        Ok("the arm did not return to the previous step, and holds where it is")
    }

    /// Waits until the arm stands still. Returns the next image that is exposed from then on, with
    /// the mean joint positions. Returns `None` if a stop was requested.
    ///
    /// # Errors
    /// If a device fails, the arm does not come to rest, or no image can be decoded.
    pub fn image(&mut self, stop: &Stop) -> anyhow::Result<Option<CalibrationImage>> {
        // Queued states are read first, so that the wait starts at the newest state and not at a
        // state from before the motion.
        self.read_queued()?;
        let began = self.read()?.stamp;
        let mut wait = Wait::new(began);
        self.first.get_or_insert(began);
        let mut seen = Seen::Nothing;
        loop {
            if stop.requested() {
                return Ok(None);
            }
            // Reading the states detects faults. The check of the time then ends the wait if no
            // image is usable.
            self.read_queued()?;
            wait.advance(self.read()?.stamp);
            self.check_wait(&wait, &seen)?;
            let image = match self.camera.next_image(POLL) {
                Ok(image) => image,
                Err(drivers::Error::SimulationLags { .. }) => {
                    wait.is_simulation_late = true;
                    continue;
                }
                Err(
                    drivers::Error::NoImage { .. }
                    | drivers::Error::Reconnecting { .. }
                    | drivers::Error::NotDue { .. },
                ) => continue,
                Err(error) => return Err(error.into()),
            };
            // All rows are exposed between `start` and `end`. The arm must also have been at rest
            // for some time before, because it swings after a motion.
            let [start, end] = self.exposure(&image);
            let settling = start.plus_secs(-SETTLE_SECS);
            if image.is_depth() {
                continue;
            }
            // Queued images may be from before the motion.
            if settling < began {
                seen = Seen::Old {
                    secs: began.secs_since(start),
                };
                continue;
            }
            if !self.wait_for_states(end, &mut wait, stop)? {
                return Ok(None);
            }
            let joints = match self.joints_at_rest(settling, end) {
                Ok(joints) => joints,
                Err(reason) => {
                    seen = reason;
                    continue;
                }
            };
            let Some(gray) = gray_of(&image) else {
                seen = Seen::Undecodable;
                continue;
            };
            return Ok(Some(self.calibration_image(&image, gray, joints)?));
        }
    }

    /// Waits until joint states cover an image that is exposed until `end`. Returns false if a stop
    /// was requested.
    fn wait_for_states(
        &mut self,
        end: Stamp,
        wait: &mut Wait,
        stop: &Stop,
    ) -> anyhow::Result<bool> {
        while self.recent.back().is_none_or(|newest| newest.stamp < end) {
            if stop.requested() {
                return Ok(false);
            }
            let now = self.read()?.stamp;
            wait.advance(now);
            // If the clocks of camera and arm differ, the joint states may never reach `end`.
            let seen = Seen::Early {
                secs: end.secs_since(now),
            };
            self.check_wait(wait, &seen)?;
        }
        Ok(true)
    }

    /// The calibration image of a camera image that was exposed with the arm at rest.
    fn calibration_image(
        &self,
        image: &Image,
        gray: Vec<u8>,
        joints: Vec<f64>,
    ) -> anyhow::Result<CalibrationImage> {
        let pose = self.chain.forward(&joints)?;
        Ok(CalibrationImage {
            secs: self
                .first
                .map_or(0.0, |first| image.stamp.secs_since(first)),
            size_px: image.size_px,
            gray,
            arm: Some(ArmDuringImage {
                base_from_flange: pose,
                // At rest, all rows see the same pose.
                base_from_flange_at_rows: [pose; 2],
                joints,
            }),
        })
    }

    /// Reads the joint states that have arrived, so that a slow caller does not fall behind.
    /// Simulated devices only advance when a program reads them.
    fn read_queued(&mut self) -> anyhow::Result<()> {
        if self.camera.waits_for_caller() {
            return Ok(());
        }
        let recent = &mut self.recent;
        self.arm.read_queued(|state| remember(recent, state))
    }

    fn check_wait(&self, wait: &Wait, seen: &Seen) -> anyhow::Result<()> {
        if wait.secs <= MAX_WAIT_SECS {
            return Ok(());
        }
        let camera = &self.camera().name;
        let clocks = "check that the stamps of the camera and of the arm are on the same clock";
        let reason = match seen {
            Seen::Nothing => "no image arrived; check that the camera delivers images".to_owned(),
            Seen::Undecodable => {
                "the images cannot be decoded; choose another pixel format".to_owned()
            }
            Seen::Old { secs } => {
                format!(
                    "the last image was exposed {secs:.1} s before the arm came to rest; {clocks}"
                )
            }
            Seen::Early { secs } => {
                format!("the last image is {secs:.1} s ahead of the joint states; {clocks}")
            }
            Seen::FewStates => {
                format!(
                    "there are too few joint states during the images; check the rate of the arm, and {clocks}"
                )
            }
            Seen::Drift { joint_ix, drift } => format!(
                "joint {:?} drifts by {drift:.5} rad within {SETTLE_SECS} s (at most {MAX_DRIFT}); let the arm hold still, or raise the stiffness",
                self.rig.arm.joints[*joint_ix]
            ),
        };
        bail!("camera {camera:?}: no image with the arm at rest within {MAX_WAIT_SECS} s: {reason}")
    }

    /// Time span in which the rows of an image are exposed.
    fn exposure(&self, image: &Image) -> [Stamp; 2] {
        let camera = self.camera();
        let mid = camera.mid_exposure(image.stamp);
        let configured = camera.exposure_micros.map(|micros| 1e-6 * micros);
        let exposure_secs = image.exposure_secs.or(configured).unwrap_or(0.0);
        // The exposure of the first row starts half an exposure time before its middle. The
        // exposure of the last row ends half an exposure time after its middle.
        let half_secs = 0.5 * (1e-6 * camera.readout_micros.unwrap_or(0.0) + exposure_secs);
        [mid.plus_secs(-half_secs), mid.plus_secs(half_secs)]
    }

    /// Mean of the joints over a time span, in the order of the chain. An error if the states do
    /// not cover it, or if a joint moves.
    fn joints_at_rest(&self, start: Stamp, end: Stamp) -> Result<Vec<f64>, Seen> {
        // Each half of the span needs at least two states for a mean.
        const MIN_STATES: usize = 4;
        let [oldest, newest] = [self.recent.front(), self.recent.back()];
        let covers = oldest.is_some_and(|state| state.stamp <= start)
            && newest.is_some_and(|state| state.stamp >= end);
        let span: Vec<&JointState> = self
            .recent
            .iter()
            .filter(|state| (start..=end).contains(&state.stamp))
            .collect();
        if !covers || span.len() < MIN_STATES {
            return Err(Seen::FewStates);
        }
        // The means of both halves are compared, because the noise of single readings may exceed
        // [`MAX_DRIFT`].
        let (early, late) = span.split_at(span.len() / 2);
        match largest_error(&mean(early), &mean(late)) {
            Some((joint_ix, drift)) if drift > MAX_DRIFT => Err(Seen::Drift { joint_ix, drift }),
            _ => Ok(self.in_chain_order(&mean(&span))),
        }
    }

    fn in_chain_order(&self, position: &[f64]) -> Vec<f64> {
        self.order.iter().map(|ix| position[*ix]).collect()
    }

    fn read(&mut self) -> anyhow::Result<JointState> {
        let state = self.arm.read()?;
        remember(&mut self.recent, &state);
        Ok(state)
    }

    /// Holds the arm in place until a stop is requested.
    ///
    /// # Errors
    /// If the arm stops because of a fault.
    pub fn hold(&mut self, stop: &Stop) -> anyhow::Result<()> {
        self.arm.hold(stop, |_| ())
    }
}

/// The joint with the largest distance from its target, and this distance.
fn largest_error(actual: &[f64], target: &[f64]) -> Option<(usize, f64)> {
    let errors = actual
        .iter()
        .zip(target)
        .map(|(actual, target)| (actual - target).abs());
    errors.enumerate().max_by(|a, b| a.1.total_cmp(&b.1))
}

/// Mean joint positions.
fn mean(states: &[&JointState]) -> Vec<f64> {
    let n_joints = states.first().map_or(0, |state| state.position.len());
    let of = |ix: usize| {
        states.iter().map(|state| state.position[ix]).sum::<f64>() / states.len() as f64
    };
    (0..n_joints).map(of).collect()
}

fn remember(recent: &mut VecDeque<JointState>, state: &JointState) {
    if recent.len() >= MAX_STATES {
        recent.pop_front();
    }
    recent.push_back(state.clone());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_of_a_late_simulation_does_not_count() {
        let at = |secs: f64| Stamp(0).plus_secs(secs);
        let mut wait = Wait::new(at(100.0));
        wait.advance(at(105.0));
        assert_eq!(wait.secs, 5.0);
        wait.is_simulation_late = true;
        wait.advance(at(125.0));
        assert_eq!(wait.secs, 5.0, "the camera was late until then");
        wait.advance(at(126.0));
        assert_eq!(wait.secs, 6.0);
    }
}
