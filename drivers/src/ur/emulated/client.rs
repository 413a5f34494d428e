//! One RTDE client of an emulated controller: requests and data packages.

use super::super::message::{self, Package, PackageSplitter, PackageType};
use super::ControllerConfig;
use super::variables::{self, Values};
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;

/// ID of the only output recipe of a client.
const OUTPUT_ID: u8 = 1;
/// Bytes to receive at once.
const RECEIVE_BYTES: usize = 4096;

/// A connected client.
#[derive(Debug)]
pub(super) struct Client {
    stream: TcpStream,
    splitter: PackageSplitter,
    outputs: Vec<String>,
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
            n_cycles_per_package: 1,
            is_started: false,
        }
    }

    /// Answers the requests that have arrived. Returns whether the client is still connected.
    pub(super) fn serve(&mut self, config: &ControllerConfig, values: &Values) -> bool {
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
                    if !self.answer(&package, config, values) {
                        return false;
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

    fn answer(&mut self, package: &Package, config: &ControllerConfig, values: &Values) -> bool {
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
            PackageType::SetupOutputs => self.set_outputs(payload, config, values),
            PackageType::Start | PackageType::Pause => {
                let is_start = package.package_type == PackageType::Start;
                let is_accepted = !self.outputs.is_empty();
                self.is_started = is_start && is_accepted;
                vec![u8::from(is_accepted || !is_start)]
            }
            PackageType::SetupInputs | PackageType::Data | PackageType::TextMessage => return true,
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
        let names = String::from_utf8_lossy(names).into_owned();
        let names: Vec<String> = names
            .split(',')
            .map(|name| name.trim().to_owned())
            .collect();
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
