//! One RTDE client of an emulated controller: requests and data packages.

use super::super::message::{self, Package, PackageSplitter, PackageType};
use super::ControllerConfig;
use super::robot::Robot;
use super::variables::{self, Values};
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;

/// ID of the only output recipe of a client.
const OUTPUT_ID: u8 = 1;
/// Maximum number of input recipes of a client.
const MAX_INPUTS: usize = 8;
/// Bytes to receive at once.
const RECEIVE_BYTES: usize = 4096;

/// A connected client.
#[derive(Debug)]
pub(super) struct Client {
    stream: TcpStream,
    splitter: PackageSplitter,
    outputs: Vec<String>,
    /// Input recipes. The ID of a recipe is its index plus one.
    inputs: Vec<Vec<String>>,
    /// Number of cycles per data package.
    n_cycles_per_package: u64,
    is_started: bool,
}

impl Client {
    /// * `stream`: in non-blocking mode
    pub(super) fn new(stream: TcpStream) -> Self {
        Self {
            stream,
            splitter: PackageSplitter::default(),
            outputs: Vec::new(),
            inputs: Vec::new(),
            n_cycles_per_package: 1,
            is_started: false,
        }
    }

    /// The input variables that this client writes.
    pub(super) fn held_inputs(&self) -> impl Iterator<Item = &String> {
        self.inputs.iter().flatten()
    }

    /// Answers the requests that have arrived, and writes inputs to the robot. Returns whether the
    /// client is still connected.
    ///
    /// * `held`: the input variables that other clients write
    /// * `takes_one`: whether later inputs are kept for the next call
    pub(super) fn serve(
        &mut self,
        config: &ControllerConfig,
        robot: &mut Robot,
        held: &[String],
        takes_one: bool,
    ) -> bool {
        let mut bytes = [0; RECEIVE_BYTES];
        loop {
            match self.stream.read(&mut bytes) {
                Ok(0) => return false,
                Ok(n) => self.splitter.push(&bytes[..n]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(_) => return false,
            }
        }
        loop {
            match self.splitter.next() {
                Ok(Some(package)) => {
                    if !self.answer(&package, config, robot, held) {
                        return false;
                    }
                    if takes_one && package.package_type == PackageType::Data {
                        return true;
                    }
                }
                Ok(None) => return true,
                // A real controller closes the connection as well.
                Err(_) => return false,
            }
        }
    }

    /// Sends the state of a cycle if it is due. Returns whether the client is still connected.
    pub(super) fn send_state(&mut self, cycle: u64, values: &Values) -> SentState {
        if !self.is_started || !cycle.is_multiple_of(self.n_cycles_per_package) {
            return SentState::NotDue;
        }
        let mut payload = vec![OUTPUT_ID];
        for name in &self.outputs {
            payload.extend(variables::output_bytes(values, name));
        }
        self.send_or_skip(&message::encode(PackageType::Data, &payload))
    }

    /// Sends bytes at once. As on a real controller, a client that does not read misses packages.
    pub(super) fn send_or_skip(&mut self, bytes: &[u8]) -> SentState {
        match self.stream.write(bytes) {
            Ok(n) if n == bytes.len() => SentState::Sent,
            Err(error) if error.kind() == ErrorKind::WouldBlock => SentState::NotDue,
            // After a part of a package, the client cannot find the next one.
            _ => SentState::Disconnected,
        }
    }

    fn answer(
        &mut self,
        package: &Package,
        config: &ControllerConfig,
        robot: &mut Robot,
        held: &[String],
    ) -> bool {
        let payload = &package.payload;
        let answer = match package.package_type {
            PackageType::RequestProtocolVersion => {
                let requested = payload
                    .first_chunk()
                    .map(|bytes| u16::from_be_bytes(*bytes));
                vec![u8::from(requested == Some(config.rtde_version))]
            }
            PackageType::GetControllerVersion => {
                let [major, minor, bugfix] = config.version;
                let numbers = [major, minor, bugfix, 0];
                numbers.iter().flat_map(|n| n.to_be_bytes()).collect()
            }
            PackageType::SetupOutputs => self.set_outputs(payload, config, &robot.values),
            PackageType::SetupInputs => self.add_inputs(payload, held),
            PackageType::Start | PackageType::Pause => {
                let is_start = package.package_type == PackageType::Start;
                let is_accepted = !self.outputs.is_empty();
                self.is_started = is_start && is_accepted;
                vec![u8::from(is_accepted || !is_start)]
            }
            PackageType::Data => return self.write_inputs(payload, robot),
            PackageType::TextMessage => return true,
        };
        let bytes = message::encode(package.package_type, &answer);
        self.send_or_skip(&bytes) == SentState::Sent
    }

    /// Sets the variables to send. Returns the answer: recipe ID and types.
    fn set_outputs(
        &mut self,
        payload: &[u8],
        config: &ControllerConfig,
        values: &Values,
    ) -> Vec<u8> {
        let Some((rate, names)) = payload.split_first_chunk() else {
            return vec![0];
        };
        let names = message::decode_names(names);
        let types: Vec<&str> = names
            .iter()
            .map(|name| {
                let is_unknown = config.unknown_variables.contains(name);
                let known = variables::output_type(values, name).filter(|_| !is_unknown);
                known.unwrap_or("NOT_FOUND")
            })
            .collect();
        let is_valid = !types.contains(&"NOT_FOUND");
        self.outputs = if is_valid { names } else { Vec::new() };
        self.n_cycles_per_package = n_cycles_per_package(config, f64::from_be_bytes(*rate));
        let id = if is_valid { OUTPUT_ID } else { 0 };
        [&[id], types.join(",").as_bytes()].concat()
    }

    /// Adds an input recipe. Returns the answer: recipe ID and types.
    fn add_inputs(&mut self, payload: &[u8], held: &[String]) -> Vec<u8> {
        let names = message::decode_names(payload);
        let types: Vec<&str> = names
            .iter()
            .map(|name| match Robot::input_type(name) {
                Some(_) if held.contains(name) => "IN_USE",
                Some(type_name) => type_name,
                None => "NOT_FOUND",
            })
            .collect();
        let is_valid = !types.contains(&"IN_USE") && !types.contains(&"NOT_FOUND");
        let mut id = 0;
        if is_valid && self.inputs.len() < MAX_INPUTS {
            self.inputs.push(names);
            id = u8::try_from(self.inputs.len()).unwrap_or(0);
        }
        [&[id], types.join(",").as_bytes()].concat()
    }

    /// Writes the values of a data package. Returns false if the package is wrong; a real
    /// controller closes the connection as well.
    fn write_inputs(&self, payload: &[u8], robot: &mut Robot) -> bool {
        let Some((id, values)) = payload.split_first() else {
            return false;
        };
        let recipe = usize::from(*id).checked_sub(1);
        let names = recipe.and_then(|ix| self.inputs.get(ix));
        self.is_started && names.is_some_and(|names| robot.write_inputs(names, values))
    }
}

/// Outcome of sending a state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SentState {
    Sent,
    NotDue,
    Disconnected,
}

/// Cycles per package for a requested rate, which is at most that of the controller.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the rate is at most 500 Hz, and a cast saturates"
)]
fn n_cycles_per_package(config: &ControllerConfig, rate_hz: f64) -> u64 {
    let n = (config.rate_hz() / rate_hz.max(1.0)).round() as u64;
    n.max(1)
}
