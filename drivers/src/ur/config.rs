//! Configuration of an arm from the rig file.

use kinematics::Chain;

/// Configuration of an arm from the rig file.
#[derive(Clone, Debug)]
pub struct ArmConfig {
    /// Host of the controller, with the port of RTDE if it is not 30004.
    pub address: String,
    /// The six joints, from the base to the flange.
    pub joint_names: Vec<String>,
    /// Chain from the parent link of the first joint to the flange.
    pub chain: Chain,
}
