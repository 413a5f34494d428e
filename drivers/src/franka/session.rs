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
const LOOK: Duration = Duration::from_millis(1);
/// What is said where a controller does not let us in.
const WAY_BESIDE: &str = "FCI takes one client at a time: end the other one, or let it send the joint states and set \
                          arm.driver = \"udp\" (docs/reference/udp.md)";

/// An open connection; dropping it ends it.
#[derive(Debug)]
pub(super) struct Session {
    pub(super) network: Network,
    pub(super) version: FciVersion,
}

/// What a controller answered.
enum Answer {
    Welcome(Network),
    OtherVersion(u16),
}

impl Session {
    /// Connects as FCI 10, or as FCI 5 where the controller speaks that.
    pub(super) fn open(address: &str) -> Result<Self, Error> {
        let fault = |reason| Error::Fci { address: address.to_owned(), reason };
        let connect = |version: FciVersion| connect(address, number(version)).map_err(fault);
        let told = match connect(FciVersion::V10)? {
            Answer::Welcome(network) => return Ok(Self { network, version: FciVersion::V10 }),
            Answer::OtherVersion(told) => told,
        };
        if told == number(FciVersion::V5) {
            // The connection that asked for FCI 10 may still be the one client that it takes.
            let until = clock::now() + MAX_ANSWER;
            loop {
                match connect(FciVersion::V5) {
                    Ok(Answer::Welcome(network)) => return Ok(Self { network, version: FciVersion::V5 }),
                    Err(_) if clock::now() < until => std::thread::sleep(POLL),
                    Err(error) => return Err(error),
                    Ok(Answer::OtherVersion(_)) => break,
                }
            }
        }
        Err(fault(format!("it speaks version {told} of FCI; versions 5 (Panda) and 10 (FR3) are read here")))
    }
}

fn number(version: FciVersion) -> u16 {
    match version {
        FciVersion::V5 => robot::v5::ROBOT_VERSION,
        FciVersion::V10 => ROBOT_VERSION,
    }
}

/// Connects and says which version we speak.
fn connect(address: &str, version: u16) -> Result<Answer, String> {
    let network =
        Network::connect_with_timeouts(address, ROBOT_COMMAND_PORT, HeaderLayout::Robot, DEFAULT_CONNECT_TIMEOUT, POLL);
    // Nobody is there, or nobody by this name: other clients are not the cause.
    let network = network.map_err(|error| sentence(&error))?;
    let mut request = version.to_le_bytes().to_vec();
    request.extend(network.udp.port().to_le_bytes());
    let hung_up = |error: FrankaError| format!("it hung up ({}). {WAY_BESIDE}", sentence(&error).trim_end_matches('.'));
    let id = network.tcp.send_request(robot::Command::Connect.to_u32(), &request).map_err(hung_up)?;
    let Some(message) = answer(&network, id, MAX_ANSWER).map_err(hung_up)? else {
        return Err(format!("it does not answer. {WAY_BESIDE}"));
    };
    let [status, low, high, ..] = *message_payload(HeaderLayout::Robot, &message) else {
        return Err("its answer to the first message is too short: is it a Franka controller?".to_owned());
    };
    // Whoever lets us in and speaks another version sends states that cannot be read.
    match (status, u16::from_le_bytes([low, high])) {
        (0, told) if told == version => Ok(Answer::Welcome(network)),
        (0 | 1, told) => Ok(Answer::OtherVersion(told)),
        (status, _) => Err(format!("it refuses with status {status}. {WAY_BESIDE}")),
    }
}

/// The answer to a request, header and all; `None` where it does not come in time.
pub(super) fn answer(network: &Network, id: u32, patience: Duration) -> Result<Option<Vec<u8>>, FrankaError> {
    let until = clock::now() + patience;
    loop {
        match network.tcp.try_receive_response(id)? {
            Some(message) => return Ok(Some(message)),
            None if clock::now() < until => std::thread::sleep(LOOK),
            None => return Ok(None),
        }
    }
}

/// What the crate says, as a sentence.
pub(super) fn sentence(error: &FrankaError) -> String {
    let text = error.to_string();
    let text = text.trim_start_matches("libfranka: ");
    match text.ends_with('.') {
        true => text.to_owned(),
        false => format!("{text}."),
    }
}
