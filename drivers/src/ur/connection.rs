//! The connection to a controller: handshake, and receiving states.

use super::N_JOINTS;
use super::address::{ControllerAddress, Interface};
use super::message::{
    self, PROTOCOL_VERSION, Package, PackageSplitter, PackageType, decode_names, decode_text,
};
use super::recipe::{Outputs, OutputsResponse};
use super::state::RobotState;
use crate::clock;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

/// Maximum time for the answer to a request. A controller answers within some milliseconds.
const MAX_ANSWER: Duration = Duration::from_secs(2);
/// Interval at which a thread that waits for a state checks for other events.
pub(super) const POLL: Duration = Duration::from_millis(100);
/// Bytes to receive at once: more than the states of 100 ms.
const RECEIVE_BYTES: usize = 32 * 1024;
/// What to check if something else than a controller answers. A test compares the port.
const CHECK_ADDRESS: &str = "check that the address belongs to a controller of Universal Robots, and that the port is 30004 (RTDE)";
/// Major version of PolyScope on CB3 controllers. Those of e-Series and later are higher.
const CB3_MAJOR: u32 = 3;

/// First of the RTDE registers that the driver uses. The registers 24 to 47 belong to external
/// clients. In our program, the input registers of numbers hold the setpoint, and those of integers
/// its number and its session.
pub(super) const FIRST_REGISTER: usize = 24;

/// Version of the software of a controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ControllerVersion {
    /// 3 for CB3, 5 for e-Series, 10 for PolyScope X.
    pub major: u32,
    /// Minor version.
    pub minor: u32,
    /// Number of the bugfix release.
    pub bugfix: u32,
}

impl ControllerVersion {
    /// Rate of the controller's control loop, Hz, at which it sends states.
    pub fn rate_hz(self) -> f64 {
        if self.major <= CB3_MAJOR {
            125.0
        } else {
            500.0
        }
    }
}

impl std::fmt::Display for ControllerVersion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}.{}.{}", self.major, self.minor, self.bugfix)
    }
}

/// An open connection that sends states. Dropping it closes the connection.
#[derive(Debug)]
pub(super) struct Connection {
    packages: PackageStream,
    pub(super) version: ControllerVersion,
    outputs: Outputs,
    output_id: u8,
    /// ID of the setpoints, if the arm may be moved.
    setpoint_id: Option<u8>,
}

/// A setpoint for the program that moves the arm.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Setpoint {
    pub(super) position_rad: [f64; N_JOINTS],
    /// Differs from that of the previous setpoint.
    pub(super) number: i32,
    /// The motion to which the setpoint belongs.
    pub(super) session: i32,
}

/// A received data package.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Reading {
    State(Box<RobotState>),
    /// The package has a wrong length or implausible values.
    Rejected,
}

/// Asks a controller for its version, and disconnects. The joints need no power.
pub(super) fn version_at(address: &str) -> Result<ControllerVersion, String> {
    PackageStream::open(address).map(|(_, version)| version)
}

impl Connection {
    /// Connects, agrees on the protocol, requests the variables, and starts the states.
    ///
    /// * `is_moved`: whether setpoints will be sent
    pub(super) fn open(address: &str, is_moved: bool) -> Result<Self, String> {
        let (mut packages, version) = PackageStream::open(address)?;
        let (outputs, output_id) = packages.request_outputs(Outputs::all(is_moved), version)?;
        let setpoint_id = if is_moved {
            Some(packages.request_setpoint()?)
        } else {
            None
        };
        packages.start()?;
        Ok(Self {
            packages,
            version,
            outputs,
            output_id,
            setpoint_id,
        })
    }

    /// Sends a setpoint. Does nothing if the connection was opened only for reading.
    pub(super) fn send_setpoint(&mut self, setpoint: &Setpoint) -> Result<(), String> {
        let Some(id) = self.setpoint_id else {
            return Ok(());
        };
        let mut payload = vec![id];
        for position_rad in setpoint.position_rad {
            payload.extend(position_rad.to_be_bytes());
        }
        payload.extend(setpoint.number.to_be_bytes());
        payload.extend(setpoint.session.to_be_bytes());
        self.packages.send(PackageType::Data, &payload)
    }

    /// Waits for the next data package; `None` if none arrives in time.
    ///
    /// # Errors
    /// If the connection is closed, or the bytes are not RTDE.
    pub(super) fn next(&mut self, timeout: Duration) -> Result<Option<Reading>, String> {
        let deadline = clock::now() + timeout;
        loop {
            if let Some(reading) = self.next_received()? {
                return Ok(Some(reading));
            }
            let remaining = deadline.duration_since(clock::now());
            if remaining.is_zero() {
                return Ok(None);
            }
            self.packages.receive(remaining)?;
        }
    }

    /// The next data package that has already been received.
    pub(super) fn next_received(&mut self) -> Result<Option<Reading>, String> {
        while let Some(package) = self.packages.next_received()? {
            match package.package_type {
                PackageType::Data => return Ok(Some(self.reading(&package))),
                _ => log_text(&package),
            }
        }
        Ok(None)
    }

    fn reading(&self, package: &Package) -> Reading {
        let state = package
            .payload
            .split_first()
            .filter(|(id, _)| **id == self.output_id)
            .and_then(|(_, values)| self.outputs.decode(values));
        state.map_or(Reading::Rejected, |state| Reading::State(Box::new(state)))
    }
}

/// The controller's messages about RTDE, for example about a variable. Other types are ignored.
fn log_text(package: &Package) {
    if package.package_type == PackageType::TextMessage
        && let Some(text) = decode_text(&package.payload)
    {
        log::warn!("arm: message of the controller: {text}");
    }
}

/// Packages over TCP.
#[derive(Debug)]
struct PackageStream {
    stream: TcpStream,
    splitter: PackageSplitter,
    /// Whether the peer has sent a package, so that it is the RTDE interface of a controller.
    is_rtde: bool,
}

impl PackageStream {
    /// Connects, agrees on the protocol, and asks for the version of the controller.
    fn open(address: &str) -> Result<(Self, ControllerVersion), String> {
        let address = ControllerAddress::parse(address)?;
        let stream = address.connect(Interface::Rtde)?;
        // A controller that does not read must not stop the thread that reads the states.
        stream
            .set_write_timeout(Some(POLL))
            .map_err(|error| format!("cannot limit the time for sending: {error}"))?;
        let mut packages = Self {
            stream,
            splitter: PackageSplitter::default(),
            is_rtde: false,
        };
        packages.agree_on_protocol()?;
        let version = packages.controller_version()?;
        Ok((packages, version))
    }

    fn agree_on_protocol(&mut self) -> Result<(), String> {
        let answer = self.ask(
            PackageType::RequestProtocolVersion,
            &PROTOCOL_VERSION.to_be_bytes(),
        )?;
        match *answer {
            [1, ..] => Ok(()),
            _ => Err(format!(
                "it rejects version {PROTOCOL_VERSION} of the RTDE protocol: update PolyScope, to at least 3.9 on a CB3 controller or 5.3 on an e-Series one"
            )),
        }
    }

    fn controller_version(&mut self) -> Result<ControllerVersion, String> {
        let answer = self.ask(PackageType::GetControllerVersion, &[])?;
        let number = |ix: usize| {
            let bytes = answer.get(4 * ix..4 * ix + 4)?;
            Some(u32::from_be_bytes(bytes.try_into().ok()?))
        };
        let version = number(0).zip(number(1)).zip(number(2));
        let Some(((major, minor), bugfix)) = version else {
            return Err(format!(
                "it reports its version in {} bytes, expected at least 12",
                answer.len()
            ));
        };
        Ok(ControllerVersion {
            major,
            minor,
            bugfix,
        })
    }

    /// Requests the variables. Returns those that the controller sends, and the ID of their
    /// packages.
    fn request_outputs(
        &mut self,
        mut outputs: Outputs,
        version: ControllerVersion,
    ) -> Result<(Outputs, u8), String> {
        // A request without the unknown variables has no unknown variables.
        for _ in 0..2 {
            let (package_type, request) = outputs.request(version.rate_hz());
            let answer = self.ask(package_type, &request)?;
            match outputs.check(&answer)? {
                OutputsResponse::Accepted(id) => return Ok((outputs, id)),
                OutputsResponse::WithoutUnknown(fewer) => outputs = fewer,
            }
        }
        Err("it reports variables as unknown that it knew before".to_owned())
    }

    /// Requests the registers of setpoints. Returns the ID of their packages.
    fn request_setpoint(&mut self) -> Result<u8, String> {
        let numbers =
            (0..N_JOINTS).map(|ix| format!("input_double_register_{}", FIRST_REGISTER + ix));
        let integers = (0..2).map(|ix| format!("input_int_register_{}", FIRST_REGISTER + ix));
        let names: Vec<String> = numbers.chain(integers).collect();
        let answer = self.ask(PackageType::SetupInputs, names.join(",").as_bytes())?;
        let Some((id, types)) = answer.split_first() else {
            return Err("its answer to the list of registers is empty".to_owned());
        };
        let types = decode_names(types);
        let problem = std::iter::zip(&names, &types)
            .find(|(_, type_name)| matches!(type_name.as_str(), "IN_USE" | "NOT_FOUND"));
        match problem {
            None => Ok(*id),
            Some((name, type_name)) if type_name == "IN_USE" => Err(format!(
                "another program writes its register {name}: stop that program, for example another RTDE client or a fieldbus"
            )),
            Some((name, _)) => Err(format!(
                "it does not know the register {name}: update PolyScope"
            )),
        }
    }

    fn start(&mut self) -> Result<(), String> {
        match *self.ask(PackageType::Start, &[])? {
            [1, ..] => Ok(()),
            _ => Err("it refuses to send states: another program may hold the variables; restart the control box if no other program uses RTDE".to_owned()),
        }
    }

    /// Sends a request and waits for the payload of the answer, which has the same type.
    fn ask(&mut self, package_type: PackageType, payload: &[u8]) -> Result<Vec<u8>, String> {
        self.send(package_type, payload)?;
        let deadline = clock::now() + MAX_ANSWER;
        loop {
            while let Some(package) = self.next_received()? {
                if package.package_type == package_type {
                    return Ok(package.payload);
                }
                log_text(&package);
            }
            let remaining = deadline.duration_since(clock::now());
            if remaining.is_zero() {
                return Err(format!(
                    "it does not answer the request {package_type:?} within {MAX_ANSWER:?}; {CHECK_ADDRESS}, and that RTDE is enabled at the pendant (Settings, Security, Services)"
                ));
            }
            self.receive(remaining)?;
        }
    }

    /// The next package that has already been received.
    fn next_received(&mut self) -> Result<Option<Package>, String> {
        match self.splitter.next() {
            Ok(package) => {
                self.is_rtde |= package.is_some();
                Ok(package)
            }
            // The controller or the network has damaged the stream.
            Err(problem) if self.is_rtde => Err(problem.to_string()),
            Err(problem) => Err(format!(
                "another server answers, and not the RTDE interface of a controller of Universal Robots: {problem}; {CHECK_ADDRESS}"
            )),
        }
    }

    fn send(&mut self, package_type: PackageType, payload: &[u8]) -> Result<(), String> {
        self.stream
            .write_all(&message::encode(package_type, payload))
            .map_err(|error| format!("cannot send to it: {error}"))
    }

    /// Waits for bytes; returns without bytes if none arrive in time.
    fn receive(&mut self, timeout: Duration) -> Result<(), String> {
        let failed = |error: std::io::Error| format!("cannot receive from it: {error}");
        // A timeout of zero would mean to wait without end.
        let timeout = timeout.max(Duration::from_millis(1));
        self.stream
            .set_read_timeout(Some(timeout))
            .map_err(failed)?;
        let mut bytes = [0; RECEIVE_BYTES];
        match self.stream.read(&mut bytes) {
            Ok(0) if self.is_rtde => Err("it closed the connection".to_owned()),
            Ok(0) => Err(format!(
                "it closed the connection without an answer; {CHECK_ADDRESS}"
            )),
            Ok(n) => {
                self.splitter.push(&bytes[..n]);
                Ok(())
            }
            Err(error)
                if matches!(
                    error.kind(),
                    ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
                ) =>
            {
                Ok(())
            }
            Err(error) => Err(failed(error)),
        }
    }
}
