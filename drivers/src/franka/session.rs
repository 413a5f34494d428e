//! A connection to a robot's controller: who is there, which version it speaks, whether it lets us in.

use crate::{Error, clock};
use franka::network::{DEFAULT_CONNECT_TIMEOUT, Network};
use franka::wire::{HeaderLayout, ROBOT_COMMAND_PORT, ROBOT_VERSION, message_payload, robot};
use franka::{FciVersion, FrankaError};
use std::time::Duration;

/// How soon whoever waits for a state notices that none comes.
pub(super) const POLL: Duration = Duration::from_millis(100);
/// A controller that takes us answers within milliseconds.
const MAX_ANSWER: Duration = Duration::from_secs(2);
/// How often an answer is looked for.
const POLL_INTERVAL: Duration = Duration::from_millis(1);
/// What is said where a controller does not let us in.
const ONE_CLIENT_HINT: &str = "FCI takes one client at a time: end the other one, or let it send the joint states and set \
                          arm.driver = \"udp\" (docs/reference/udp.md)";

/// An open connection; dropping it ends it.
#[derive(Debug)]
pub(super) struct Session {
    pub(super) network: Network,
    pub(super) version: FciVersion,
}

/// What a controller answered.
enum ConnectResponse {
    Accepted(Network),
    OtherVersion(u16),
}

impl Session {
    /// Connects as FCI 10, or as FCI 5 where the controller speaks that.
    pub(super) fn open(address: &str) -> Result<Self, Error> {
        let fault = |reason| Error::Fci { address: address.to_owned(), reason };
        let connect = |version: FciVersion| connect(address, number(version)).map_err(fault);
        let server_version = match connect(FciVersion::V10)? {
            ConnectResponse::Accepted(network) => return Ok(Self { network, version: FciVersion::V10 }),
            ConnectResponse::OtherVersion(server_version) => server_version,
        };
        if server_version == number(FciVersion::V5) {
            // The connection that asked for FCI 10 may still be the one client that it takes.
            let deadline = clock::now() + MAX_ANSWER;
            loop {
                match connect(FciVersion::V5) {
                    Ok(ConnectResponse::Accepted(network)) => return Ok(Self { network, version: FciVersion::V5 }),
                    Err(_) if clock::now() < deadline => std::thread::sleep(POLL),
                    Err(error) => return Err(error),
                    Ok(ConnectResponse::OtherVersion(_)) => break,
                }
            }
        }
        Err(fault(format!("it speaks version {server_version} of FCI; versions 5 (Panda) and 10 (FR3) are read here")))
    }
}

fn number(version: FciVersion) -> u16 {
    match version {
        FciVersion::V5 => robot::v5::ROBOT_VERSION,
        FciVersion::V10 => ROBOT_VERSION,
    }
}

/// Connects and says which version we speak.
fn connect(address: &str, version: u16) -> Result<ConnectResponse, String> {
    let network =
        Network::connect_with_timeouts(address, ROBOT_COMMAND_PORT, HeaderLayout::Robot, DEFAULT_CONNECT_TIMEOUT, POLL);
    // Nobody is there, or nobody by this name: other clients are not the cause.
    let network = network.map_err(|error| error_text(&error))?;
    let mut request = version.to_le_bytes().to_vec();
    request.extend(network.udp.port().to_le_bytes());
    let disconnected =
        |error: FrankaError| format!("it hung up ({}). {ONE_CLIENT_HINT}", error_text(&error).trim_end_matches('.'));
    let id = network.tcp.send_request(robot::Command::Connect.to_u32(), &request).map_err(disconnected)?;
    let Some(message) = answer(&network, id, MAX_ANSWER).map_err(disconnected)? else {
        return Err(format!("it does not answer. {ONE_CLIENT_HINT}"));
    };
    let [status, low, high, ..] = *message_payload(HeaderLayout::Robot, &message) else {
        return Err("its answer to the first message is too short: is it a Franka controller?".to_owned());
    };
    // Whoever lets us in and speaks another version sends states that cannot be read.
    match (status, u16::from_le_bytes([low, high])) {
        (0, server_version) if server_version == version => Ok(ConnectResponse::Accepted(network)),
        (0 | 1, server_version) => Ok(ConnectResponse::OtherVersion(server_version)),
        (status, _) => Err(format!("it refuses with status {status}. {ONE_CLIENT_HINT}")),
    }
}

/// The answer to a request, header and all; `None` where it does not come in time.
pub(super) fn answer(network: &Network, id: u32, timeout: Duration) -> Result<Option<Vec<u8>>, FrankaError> {
    let deadline = clock::now() + timeout;
    loop {
        match network.tcp.try_receive_response(id)? {
            Some(message) => return Ok(Some(message)),
            None if clock::now() < deadline => std::thread::sleep(POLL_INTERVAL),
            None => return Ok(None),
        }
    }
}

/// What the crate says, as a sentence.
pub(super) fn error_text(error: &FrankaError) -> String {
    let text = error.to_string();
    let text = text.trim_start_matches("libfranka: ");
    match text.ends_with('.') {
        true => text.to_owned(),
        false => format!("{text}."),
    }
}
