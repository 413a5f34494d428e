//! The variables that a controller sends in each data package, and their decoding.

use super::N_JOINTS;
use super::message::{PackageType, decode_names};
use super::state::RobotState;

/// Maximum length of the list of variables in a request, in bytes. Source: RTDE guide.
#[cfg(test)]
const MAX_LIST_BYTES: usize = 2048;
/// Type that a controller reports for a variable that it does not know.
const NOT_FOUND: &str = "NOT_FOUND";

/// A variable that the driver reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Variable {
    Timestamp,
    Position,
    Velocity,
    Torque,
    Target,
    ToolPose,
    ToolOffset,
    RobotMode,
    SafetyMode,
    SafetyStatus,
    RuntimeState,
    StatusBits,
    Program,
    ProgramEnd,
}

/// Whether a controller must know a variable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Need {
    Always,
    /// Older controllers do not know the variable.
    IfKnown,
    /// The variable is needed to move the arm.
    ToMove,
}

/// A variable with its name, type and need.
struct Entry {
    variable: Variable,
    name: &'static str,
    type_name: &'static str,
    need: Need,
}

const fn entry(
    variable: Variable,
    name: &'static str,
    type_name: &'static str,
    need: Need,
) -> Entry {
    Entry {
        variable,
        name,
        type_name,
        need,
    }
}

/// All variables. Source of names and types: RTDE guide, "Robot controller outputs".
///
/// The registers 24 to 47 belong to external clients. The lower ones belong to fieldbuses.
const ENTRIES: [Entry; 14] = [
    entry(Variable::Timestamp, "timestamp", "DOUBLE", Need::Always),
    entry(Variable::Position, "actual_q", "VECTOR6D", Need::Always),
    entry(Variable::Velocity, "actual_qd", "VECTOR6D", Need::Always),
    entry(
        Variable::Torque,
        "actual_current_as_torque",
        "VECTOR6D",
        Need::IfKnown,
    ),
    entry(Variable::Target, "target_q", "VECTOR6D", Need::Always),
    entry(
        Variable::ToolPose,
        "actual_TCP_pose",
        "VECTOR6D",
        Need::Always,
    ),
    entry(
        Variable::ToolOffset,
        "tcp_offset",
        "VECTOR6D",
        Need::IfKnown,
    ),
    entry(Variable::RobotMode, "robot_mode", "INT32", Need::Always),
    entry(Variable::SafetyMode, "safety_mode", "INT32", Need::Always),
    entry(
        Variable::SafetyStatus,
        "safety_status",
        "INT32",
        Need::IfKnown,
    ),
    entry(
        Variable::RuntimeState,
        "runtime_state",
        "UINT32",
        Need::Always,
    ),
    entry(
        Variable::StatusBits,
        "robot_status_bits",
        "UINT32",
        Need::IfKnown,
    ),
    entry(
        Variable::Program,
        "output_int_register_24",
        "INT32",
        Need::ToMove,
    ),
    entry(
        Variable::ProgramEnd,
        "output_int_register_25",
        "INT32",
        Need::ToMove,
    ),
];

/// Variables to request from a controller, in the order of the data packages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Outputs(Vec<Variable>);

/// Response of a controller to a request for variables.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum OutputsResponse {
    /// The controller sends these variables under this recipe ID.
    Accepted(u8),
    /// The controller does not know some variables that are not needed. The request must be
    /// repeated without them.
    WithoutUnknown(Outputs),
}

impl Outputs {
    /// All variables for an arm that is read, or also moved.
    pub(super) fn all(is_moved: bool) -> Self {
        let is_wanted = |entry: &&Entry| is_moved || entry.need != Need::ToMove;
        Self(
            ENTRIES
                .iter()
                .filter(is_wanted)
                .map(|entry| entry.variable)
                .collect(),
        )
    }

    fn entries(&self) -> impl Iterator<Item = &'static Entry> + '_ {
        self.0.iter().map(|variable| entry_of(*variable))
    }

    /// Payload of the request for these variables at a rate.
    pub(super) fn request(&self, rate_hz: f64) -> (PackageType, Vec<u8>) {
        let names: Vec<&str> = self.entries().map(|entry| entry.name).collect();
        let mut payload = rate_hz.to_be_bytes().to_vec();
        payload.extend_from_slice(names.join(",").as_bytes());
        (PackageType::SetupOutputs, payload)
    }

    /// Checks the response: a recipe ID, and the types of the variables.
    ///
    /// # Errors
    /// If the controller does not know a variable that is needed, or reports another type.
    pub(super) fn check(&self, payload: &[u8]) -> Result<OutputsResponse, String> {
        let Some((recipe_id, types)) = payload.split_first() else {
            return Err("its answer to the list of variables is empty".to_owned());
        };
        let types = decode_names(types);
        if types.len() != self.0.len() {
            return Err(format!(
                "it answered with {} types for {} variables",
                types.len(),
                self.0.len()
            ));
        }
        let mut known = Vec::new();
        for (entry, type_name) in self.entries().zip(types) {
            if type_name == entry.type_name {
                known.push(entry.variable);
            } else if type_name != NOT_FOUND {
                return Err(format!(
                    "its variable {:?} has the type {type_name:?}, expected {:?}",
                    entry.name, entry.type_name
                ));
            } else if entry.need != Need::IfKnown {
                return Err(format!(
                    "it does not know the variable {:?}: update PolyScope, to at least 3.9 on a CB3 controller or 5.3 on an e-Series one",
                    entry.name
                ));
            }
        }
        if known.len() < self.0.len() {
            return Ok(OutputsResponse::WithoutUnknown(Self(known)));
        }
        Ok(OutputsResponse::Accepted(*recipe_id))
    }

    /// Decodes the values of a data package, without its recipe ID. `None` if the number of bytes
    /// is wrong or a value is implausible.
    pub(super) fn decode(&self, values: &[u8]) -> Option<RobotState> {
        let mut values = Values(values);
        let mut state = RobotState::default();
        for variable in &self.0 {
            match variable {
                Variable::Timestamp => state.timestamp_secs = values.double()?,
                Variable::Position => state.position_rad = values.doubles()?,
                Variable::Velocity => state.velocity_rad_s = values.doubles()?,
                Variable::Torque => state.torque_nm = Some(values.doubles()?),
                Variable::Target => state.target_rad = values.doubles()?,
                Variable::ToolPose => state.base_from_tool = values.doubles()?,
                Variable::ToolOffset => state.flange_from_tool = Some(values.doubles()?),
                Variable::RobotMode => state.robot_mode = values.int()?,
                Variable::SafetyMode => state.safety_mode = values.int()?,
                Variable::SafetyStatus => state.safety_status = Some(values.int()?),
                Variable::RuntimeState => state.runtime_state = values.unsigned()?,
                Variable::StatusBits => state.status_bits = values.unsigned()?,
                Variable::Program => state.program[0] = values.int()?,
                Variable::ProgramEnd => state.program[1] = values.int()?,
            }
        }
        (values.0.is_empty() && state.is_plausible()).then_some(state)
    }
}

fn entry_of(variable: Variable) -> &'static Entry {
    let entry = ENTRIES.iter().find(|entry| entry.variable == variable);
    entry.expect("the table has all variables")
}

/// The values that remain in a data package. All are big-endian.
struct Values<'a>(&'a [u8]);

impl Values<'_> {
    fn bytes<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*first)
    }

    fn double(&mut self) -> Option<f64> {
        self.bytes().map(f64::from_be_bytes)
    }

    fn doubles(&mut self) -> Option<[f64; N_JOINTS]> {
        let mut numbers = [0.0; N_JOINTS];
        for number in &mut numbers {
            *number = self.double()?;
        }
        Some(numbers)
    }

    fn int(&mut self) -> Option<i32> {
        self.bytes().map(i32::from_be_bytes)
    }

    fn unsigned(&mut self) -> Option<u32> {
        self.bytes().map(u32::from_be_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn types(outputs: &Outputs) -> Vec<&'static str> {
        outputs.entries().map(|entry| entry.type_name).collect()
    }

    #[test]
    fn request_lists_rate_and_names() {
        let outputs = Outputs::all(true);
        let (package_type, payload) = outputs.request(500.0);
        assert_eq!(package_type, PackageType::SetupOutputs);
        assert_eq!(payload[..8], 500.0_f64.to_be_bytes());
        let names = String::from_utf8(payload[8..].to_vec()).unwrap();
        assert!(names.starts_with("timestamp,actual_q,"), "{names}");
        assert!(names.contains("output_int_register_24") && names.len() < MAX_LIST_BYTES);
        assert_eq!(names.split(',').count(), ENTRIES.len());
        assert!(Outputs::all(false).0.len() == ENTRIES.len() - 2);
    }

    #[test]
    fn unknown_variables_are_left_out_or_reported() {
        let outputs = Outputs::all(false);
        let answer = |types: &[&str]| [&[7], types.join(",").as_bytes()].concat();
        let known = types(&outputs);
        assert_eq!(
            outputs.check(&answer(&known)),
            Ok(OutputsResponse::Accepted(7))
        );
        let without = |variable: Variable| {
            let ix = outputs
                .0
                .iter()
                .position(|known| *known == variable)
                .unwrap();
            let mut types = known.clone();
            types[ix] = NOT_FOUND;
            outputs.check(&answer(&types))
        };
        let Ok(OutputsResponse::WithoutUnknown(fewer)) = without(Variable::Torque) else {
            panic!("older controllers report no torques")
        };
        assert!(!fewer.0.contains(&Variable::Torque) && fewer.0.len() == outputs.0.len() - 1);
        let error = without(Variable::RuntimeState).unwrap_err();
        assert!(
            error.contains("runtime_state") && error.contains("PolyScope"),
            "{error}"
        );
        let mut wrong = known.clone();
        wrong[1] = "VECTOR3D";
        let error = outputs.check(&answer(&wrong)).unwrap_err();
        assert!(
            error.contains("actual_q") && error.contains("VECTOR3D"),
            "{error}"
        );
        assert!(outputs.check(&answer(&known[1..])).is_err());
        assert!(outputs.check(&[]).is_err());
    }

    #[test]
    fn truncated_and_implausible_values_are_rejected() {
        let outputs = Outputs::all(true);
        let n_bytes: usize = types(&outputs)
            .iter()
            .map(|type_name| match *type_name {
                "DOUBLE" => 8,
                "VECTOR6D" => 48,
                _ => 4,
            })
            .sum();
        let mut bytes = vec![0; n_bytes];
        bytes[..8].copy_from_slice(&12.5_f64.to_be_bytes());
        bytes[8..16].copy_from_slice(&(-1.25_f64).to_be_bytes());
        let state = outputs.decode(&bytes).unwrap();
        assert_eq!((state.timestamp_secs, state.position_rad[0]), (12.5, -1.25));
        for n in 0..n_bytes {
            assert_eq!(outputs.decode(&bytes[..n]), None, "{n} bytes");
        }
        assert_eq!(outputs.decode(&[&bytes[..], &[0]].concat()), None);
        for implausible in [f64::NAN, f64::INFINITY, 1e9] {
            let mut bytes = bytes.clone();
            bytes[16..24].copy_from_slice(&implausible.to_be_bytes());
            assert_eq!(outputs.decode(&bytes), None, "{implausible}");
        }
    }
}
