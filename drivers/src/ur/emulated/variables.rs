//! The variables of RTDE, and their values.

use super::{Joints, Modes, N_JOINTS};
use kinematics::Transform;

/// Number of registers of each type. Source: RTDE guide.
pub(super) const N_REGISTERS: usize = 48;

/// Values of all variables in one cycle.
#[derive(Clone, Debug)]
pub(super) struct Values {
    pub(super) timestamp_secs: f64,
    pub(super) joints: Joints,
    pub(super) target_rad: [f64; N_JOINTS],
    pub(super) base_from_tool: Transform,
    pub(super) flange_from_tool: Transform,
    pub(super) modes: Modes,
    pub(super) runtime_state: u32,
    pub(super) output_ints: [i32; N_REGISTERS],
}

/// Encoded values of one type.
enum Encoded {
    Double(f64),
    Vector3([f64; 3]),
    Vector6([f64; 6]),
    Ints([i32; 6]),
    Int(i32),
    Unsigned(u32),
    Long(u64),
}

impl Encoded {
    fn type_name(&self) -> &'static str {
        match self {
            Self::Double(_) => "DOUBLE",
            Self::Vector3(_) => "VECTOR3D",
            Self::Vector6(_) => "VECTOR6D",
            Self::Ints(_) => "VECTOR6INT32",
            Self::Int(_) => "INT32",
            Self::Unsigned(_) => "UINT32",
            Self::Long(_) => "UINT64",
        }
    }

    fn bytes(&self) -> Vec<u8> {
        match self {
            Self::Double(number) => number.to_be_bytes().to_vec(),
            Self::Vector3(numbers) => numbers.iter().flat_map(|n| n.to_be_bytes()).collect(),
            Self::Vector6(numbers) => numbers.iter().flat_map(|n| n.to_be_bytes()).collect(),
            Self::Ints(numbers) => numbers.iter().flat_map(|n| n.to_be_bytes()).collect(),
            Self::Int(number) => number.to_be_bytes().to_vec(),
            Self::Unsigned(number) => number.to_be_bytes().to_vec(),
            Self::Long(number) => number.to_be_bytes().to_vec(),
        }
    }
}

/// Type of an output variable; `None` if it does not exist.
pub(super) fn output_type(values: &Values, name: &str) -> Option<&'static str> {
    output(values, name).map(|encoded| encoded.type_name())
}

/// Value of an output variable as sent in a data package.
pub(super) fn output_bytes(values: &Values, name: &str) -> Vec<u8> {
    output(values, name).map_or_else(Vec::new, |encoded| encoded.bytes())
}

/// Value of an output variable. Source of names and types: RTDE guide. Variables that nothing
/// emulated affects are constant.
fn output(values: &Values, name: &str) -> Option<Encoded> {
    let Values { joints, modes, .. } = values;
    let is_ready = modes.robot_mode == 7;
    let is_playing = values.runtime_state == 2;
    Some(match name {
        "timestamp" => Encoded::Double(values.timestamp_secs),
        "actual_q" => Encoded::Vector6(joints.position_rad),
        "actual_qd" => Encoded::Vector6(joints.velocity_rad_s),
        "actual_current_as_torque" => Encoded::Vector6(joints.torque_nm),
        "target_q" => Encoded::Vector6(values.target_rad),
        "actual_TCP_pose" => Encoded::Vector6(pose_vector(&values.base_from_tool)),
        "tcp_offset" => Encoded::Vector6(pose_vector(&values.flange_from_tool)),
        "target_qd"
        | "target_qdd"
        | "target_current"
        | "target_moment"
        | "actual_current"
        | "joint_control_output"
        | "actual_TCP_speed"
        | "actual_TCP_force"
        | "target_TCP_pose"
        | "target_TCP_speed"
        | "joint_temperatures"
        | "actual_joint_voltage"
        | "payload_inertia"
        | "ft_raw_wrench" => Encoded::Vector6([0.0; 6]),
        "actual_tool_accelerometer" | "payload_cog" => Encoded::Vector3([0.0; 3]),
        // 253 is a running joint.
        "joint_mode" => Encoded::Ints([253; 6]),
        "speed_scaling" | "target_speed_fraction" => Encoded::Double(1.0),
        "actual_execution_time"
        | "actual_momentum"
        | "actual_main_voltage"
        | "actual_robot_voltage"
        | "actual_robot_current"
        | "payload"
        | "standard_analog_input0"
        | "standard_analog_input1"
        | "standard_analog_output0"
        | "standard_analog_output1" => Encoded::Double(0.0),
        "actual_digital_input_bits" | "actual_digital_output_bits" => Encoded::Long(0),
        "robot_mode" => Encoded::Int(modes.robot_mode),
        "safety_mode" | "safety_status" => Encoded::Int(modes.safety_mode),
        "runtime_state" => Encoded::Unsigned(values.runtime_state),
        "robot_status_bits" => Encoded::Unsigned(
            u32::from(is_ready)
                | u32::from(is_playing) << 1
                | u32::from(modes.is_teach_button_pressed) << 2,
        ),
        "safety_status_bits" => Encoded::Unsigned(u32::from(modes.safety_mode == 1)),
        _ => {
            let register = register_ix(name, "output_int_register_")?;
            Encoded::Int(values.output_ints[register])
        }
    })
}

/// Number of a register, if the name is that of a register of this kind.
pub(super) fn register_ix(name: &str, kind: &str) -> Option<usize> {
    let ix = name.strip_prefix(kind)?.parse().ok()?;
    (ix < N_REGISTERS).then_some(ix)
}

/// A pose as RTDE sends it: meters, and a rotation vector.
fn pose_vector(pose: &Transform) -> [f64; 6] {
    let [x, y, z] = pose.translation.vector.into();
    let [about_x, about_y, about_z] = pose.rotation.scaled_axis().into();
    [x, y, z, about_x, about_y, about_z]
}
