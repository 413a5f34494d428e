//! The surroundings of a robot, as the loop uses them.

use super::scene_clearance::SceneClearance;
use drivers::motion::ArmState;
use steering::Clearance;

/// The surroundings of a steered robot.
pub trait Surroundings: Clearance + Send + Sync + 'static {
    /// Takes the newest posture of the arm, in the order of its chain. The robot itself must not
    /// count as a surface.
    fn set_posture(&self, arm: &ArmState);

    /// Takes the newest pose of the base, if it is steered without an arm. The robot itself must not
    /// count as a surface.
    fn set_base(&self) {}

    /// The first operator takes the robot over: space that it moves through from now on does not
    /// become free because of this.
    fn end_sweep(&self);
}

impl Surroundings for SceneClearance {
    fn set_posture(&self, arm: &ArmState) {
        self.set_posture(arm);
    }

    fn set_base(&self) {
        self.set_base();
    }

    fn end_sweep(&self) {
        self.end_sweep();
    }
}
