//! Encodes the state of an emulated robot as a datagram.

use super::super::N_JOINTS;
use super::robot::{Mode, Motion, Robot, TrajectoryGenerator};
use franka::FciVersion;
use franka::wire::robot::{v5, v10};
use kinematics::{Transform, transform};
use zerocopy::IntoBytes;
use zerocopy::little_endian::{F32, F64, U64};

const GRAVITY_M_S2: f64 = -9.81;

/// State of a robot in one version's layout. Both versions have the fields that are set here.
macro_rules! state {
    ($robot:expr, $number:expr, $version:ident) => {{
        let robot: &Robot = $robot;
        let joints = &robot.joints;
        let commanded = &robot.commanded;
        let flange_from_nominal = robot.config.flange_from_tool;
        let flange_from_tool = flange_from_nominal * robot.nominal_from_tool;
        let tool_at =
            |position_rad| columns(&(robot.base_from_flange(position_rad) * flange_from_tool));
        let elbow = |position_rad: &[f64; N_JOINTS]| [position_rad[2], position_rad[3].signum()];
        let [motion_generator_mode, controller_mode, robot_mode] = robot.modes();
        let reasons = robot.reflex_reason.0.map(u8::from);
        $version::RobotState {
            message_id: U64::new($number),
            O_T_EE: numbers(&tool_at(&joints.position_rad)),
            O_T_EE_d: numbers(&tool_at(&commanded.position_rad)),
            // Commanded and desired poses agree, because nothing filters the commands.
            O_T_EE_c: numbers(&tool_at(&commanded.position_rad)),
            F_T_EE: numbers(&columns(&flange_from_tool)),
            F_T_NE: numbers(&columns(&flange_from_nominal)),
            NE_T_EE: numbers(&columns(&robot.nominal_from_tool)),
            EE_T_K: numbers(&columns(&robot.tool_from_stiffness)),
            elbow: numbers(&elbow(&joints.position_rad)),
            elbow_d: numbers(&elbow(&commanded.position_rad)),
            elbow_c: numbers(&elbow(&commanded.position_rad)),
            tau_J: numbers(&joints.torque_nm),
            tau_J_d: numbers(&joints.torque_nm),
            tau_ext_hat_filtered: numbers(&joints.external_torque_nm),
            q: numbers(&joints.position_rad),
            q_d: numbers(&commanded.position_rad),
            theta: numbers(&joints.position_rad),
            dq: numbers(&joints.velocity_rad_s),
            dq_d: numbers(&commanded.velocity_rad_s),
            dtheta: numbers(&joints.velocity_rad_s),
            ddq_d: numbers(&commanded.acceleration_rad_s2),
            O_ddP_O: numbers(&[0.0, 0.0, GRAVITY_M_S2]),
            motion_generator_mode,
            controller_mode,
            robot_mode,
            // Current errors end with the reflex. The reason for the reflex stays until the next
            // motion.
            errors: if matches!(robot.mode, Mode::Reflex) {
                reasons
            } else {
                [0; franka::errors::ERROR_COUNT]
            },
            reflex_reason: reasons,
            control_command_success_rate: Number::values(robot.success_frac()),
            ..$version::RobotState::default()
        }
    }};
}

impl Robot {
    /// Encodes the state with this number as a datagram.
    pub(super) fn state(&self, number: u64) -> Vec<u8> {
        match self.config.version {
            FciVersion::V5 => state!(self, number, v5).as_bytes().to_vec(),
            FciVersion::V10 => state!(self, number, v10).as_bytes().to_vec(),
        }
    }

    fn modes(&self) -> [u8; 3] {
        let (generator, controller, robot) = match self.mode {
            Mode::Idle => (
                v10::MotionGeneratorMode::Idle,
                v10::ControllerMode::Other,
                v10::RobotMode::Idle,
            ),
            Mode::Reflex => (
                v10::MotionGeneratorMode::Idle,
                v10::ControllerMode::Other,
                v10::RobotMode::Reflex,
            ),
            Mode::Move(Motion {
                generator: TrajectoryGenerator::Position,
                controller,
                ..
            }) => (
                v10::MotionGeneratorMode::JointPosition,
                controller,
                v10::RobotMode::Move,
            ),
            Mode::Move(Motion {
                generator: TrajectoryGenerator::Velocity,
                controller,
                ..
            }) => (
                v10::MotionGeneratorMode::JointVelocity,
                controller,
                v10::RobotMode::Move,
            ),
        };
        [generator.to_u8(), controller.to_u8(), robot.to_u8()]
    }

    fn base_from_flange(&self, position_rad: &[f64; N_JOINTS]) -> Transform {
        self.config
            .chain
            .forward(position_rad)
            .expect("the chain was checked to have seven joints")
    }
}

/// Matrix of a pose in column-major order.
fn columns(pose: &Transform) -> [f64; 16] {
    let rows = transform::to_rows(pose);
    std::array::from_fn(|at| rows[(at % 4) * 4 + at / 4])
}

/// A number of a state: FCI 5 sends doubles, FCI 10 floats.
trait Number: Copy {
    fn values(number: f64) -> Self;
}

impl Number for F64 {
    fn values(number: f64) -> Self {
        Self::new(number)
    }
}

impl Number for F32 {
    #[expect(clippy::cast_possible_truncation, reason = "FCI 10 sends floats")]
    fn values(number: f64) -> Self {
        Self::new(number as f32)
    }
}

fn numbers<T: Number, const N: usize>(values: &[f64; N]) -> [T; N] {
    values.map(T::values)
}
