//! Connection to a robot's controller and version negotiation.

use crate::{Error, clock};
use franka::network::{DEFAULT_CONNECT_TIMEOUT, Network};
use franka::wire::{HeaderLayout, ROBOT_COMMAND_PORT, ROBOT_VERSION, message_payload, robot};
use franka::{FciVersion, FrankaError};
use std::time::Duration;

/// Interval at which a thread that waits for a state checks for other events.
pub(super) const POLL: Duration = Duration::from_millis(100);
/// Maximum time for the answer to a connection request; a controller that accepts us answers within
/// milliseconds.
const MAX_ANSWER: Duration = Duration::from_secs(2);
/// Interval of checks for an answer. The crate's own wait for an answer has no time limit, so
/// answers are polled for.
const POLL_INTERVAL: Duration = Duration::from_millis(1);
/// Hint in the error if a controller rejects the connection.
const ONE_CLIENT_HINT: &str = "FCI accepts one client at a time: stop the other one; if the arm is only read, that one may \
                          send the joint states instead (arm.driver = \"udp\", docs/reference/udp.md)";

/// What to check if something else than a controller answers. A test compares the port.
const CHECK_ADDRESS: &str =
    "check that the address belongs to a Franka controller, and that the port is 1337 (FCI)";

/// An open connection. Dropping it closes the connection.
#[derive(Debug)]
pub(super) struct Connection {
    pub(super) network: Network,
    pub(super) version: FciVersion,
}

/// Response of a controller to a connection request.
enum ConnectResponse {
    Accepted(Network),
    OtherVersion(u16),
}

impl Connection {
    /// Connects with FCI 10, or with FCI 5 if the controller uses that version.
    pub(super) fn open(address: &str) -> Result<Self, Error> {
        let connect = |version: FciVersion| {
            connect(address, number(version)).map_err(|reason| fault(address, reason))
        };
        // A controller that uses another version rejects the connection, and reports its own
        // version.
        let server_version = match connect(FciVersion::V10)? {
            ConnectResponse::Accepted(network) => {
                return Ok(Self {
                    network,
                    version: FciVersion::V10,
                });
            }
            ConnectResponse::OtherVersion(server_version) => server_version,
        };
        if server_version == number(FciVersion::V5) {
            // The controller accepts only one client. It may still be serving the connection that
            // requested FCI 10.
            let deadline = clock::now() + MAX_ANSWER;
            loop {
                match connect(FciVersion::V5) {
                    Ok(ConnectResponse::Accepted(network)) => {
                        return Ok(Self {
                            network,
                            version: FciVersion::V5,
                        });
                    }
                    Err(_) if clock::now() < deadline => std::thread::sleep(POLL),
                    Err(error) => return Err(error),
                    Ok(ConnectResponse::OtherVersion(_)) => break,
                }
            }
        }
        Err(fault(
            address,
            format!(
                "it uses FCI version {server_version}; supported are versions 5 (Panda) and 10 (FR3)"
            ),
        ))
    }
}

/// An error of the controller at this address.
pub(super) fn fault(address: &str, reason: String) -> Error {
    Error::Fci {
        address: address.to_owned(),
        reason,
    }
}

/// The number of a version on the wire.
fn number(version: FciVersion) -> u16 {
    match version {
        FciVersion::V5 => robot::v5::ROBOT_VERSION,
        FciVersion::V10 => ROBOT_VERSION,
    }
}

/// Connects and sends our FCI version.
fn connect(address: &str, version: u16) -> Result<ConnectResponse, String> {
    let network = Network::connect_with_timeouts(
        address,
        ROBOT_COMMAND_PORT,
        HeaderLayout::Robot,
        DEFAULT_CONNECT_TIMEOUT,
        POLL,
    );
    // The host does not exist or refuses connections, so other clients are not the cause.
    let network = network.map_err(|error| error_text(&error))?;
    // The controller sends its states to the UDP port that the request names.
    let mut request = version.to_le_bytes().to_vec();
    request.extend(network.udp.port().to_le_bytes());
    // A controller that serves another client may accept the connection, and then close it or stay
    // silent.
    let id = network
        .tcp
        .send_request(robot::Command::Connect.to_u32(), &request)
        .map_err(disconnected)?;
    let Some(message) = answer(&network, id, MAX_ANSWER).map_err(disconnected)? else {
        return Err(format!("it does not answer. {ONE_CLIENT_HINT}"));
    };
    let [status, low, high, ..] = *message_payload(HeaderLayout::Robot, &message) else {
        return Err(no_controller(
            "its answer to the first message is too short",
        ));
    };
    // A controller that accepts us but has another version would send states that we cannot decode.
    match (status, u16::from_le_bytes([low, high])) {
        (0, server_version) if server_version == version => Ok(ConnectResponse::Accepted(network)),
        (0 | 1, server_version) => Ok(ConnectResponse::OtherVersion(server_version)),
        (status, _) => Err(format!(
            "it rejected the connection with status {status}. {ONE_CLIENT_HINT}"
        )),
    }
}

/// The reason if the negotiation fails.
fn disconnected(error: FrankaError) -> String {
    let text = error_text(&error);
    let text = text.trim_end_matches('.');
    match error {
        // The header of the answer is impossible, for example because it is text.
        FrankaError::Protocol(_) => no_controller(text),
        _ => format!("it closed the connection ({text}). {ONE_CLIENT_HINT}"),
    }
}

/// The reason if no controller has answered.
fn no_controller(problem: &str) -> String {
    format!(
        "another server answers, and not the control interface (FCI) of a Franka controller: {problem}; {CHECK_ADDRESS}"
    )
}

/// The answer to a request, including its header; `None` if it does not arrive in time.
pub(super) fn answer(
    network: &Network,
    id: u32,
    timeout: Duration,
) -> Result<Option<Vec<u8>>, FrankaError> {
    let deadline = clock::now() + timeout;
    loop {
        match network.tcp.try_receive_response(id)? {
            Some(message) => return Ok(Some(message)),
            None if clock::now() < deadline => std::thread::sleep(POLL_INTERVAL),
            None => return Ok(None),
        }
    }
}

/// The crate's error message as a sentence.
pub(super) fn error_text(error: &FrankaError) -> String {
    let text = error.to_string();
    let text = text.trim_start_matches("libfranka: ");
    if text.ends_with('.') {
        text.to_owned()
    } else {
        format!("{text}.")
    }
}
