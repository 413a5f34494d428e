//! The surroundings of an arm, as the loop uses them.

use super::scene_clearance::SceneClearance;
use drivers::motion::ArmState;
use steering::Clearance;

/// The surroundings of a steered arm.
pub trait Surroundings: Clearance + Send + Sync + 'static {
    /// Takes the newest posture of the arm, in the order of its chain. The robot itself must not
    /// count as a surface.
    fn set_posture(&self, arm: &ArmState);

    /// The first operator takes the arm over: space that it moves through from now on does not
    /// become free because of this.
    fn end_sweep(&self);
}

impl Surroundings for SceneClearance {
    fn set_posture(&self, arm: &ArmState) {
        self.set_posture(arm);
    }

    fn end_sweep(&self) {
        self.end_sweep();
    }
}
