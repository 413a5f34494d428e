//! Commands to the dashboard server of a controller, which answers each line with a line.

use super::address::{ControllerAddress, Interface};
use std::io::{BufRead, BufReader, Read, Write};
use std::time::Duration;

/// Maximum time for an answer.
const MAX_ANSWER: Duration = Duration::from_secs(2);
/// Maximum length of an answer. Those of a dashboard server are below 200 bytes.
const MAX_ANSWER_BYTES: u64 = 4096;

/// Sends commands one after another over one connection, and returns their answers.
///
/// # Errors
/// If the server cannot be reached or does not answer. PolyScope X has no dashboard server, and on
/// an e-Series controller it can be disabled.
pub(super) fn ask<const N: usize>(
    address: &ControllerAddress,
    commands: [&str; N],
) -> Result<[String; N], String> {
    let failed = |error: std::io::Error| format!("its dashboard server does not answer: {error}");
    let mut stream = address.connect(Interface::Dashboard)?;
    stream.set_read_timeout(Some(MAX_ANSWER)).map_err(failed)?;
    stream.set_write_timeout(Some(MAX_ANSWER)).map_err(failed)?;
    let reading = stream.try_clone().map_err(failed)?;
    let mut lines = BufReader::new(reading.take(MAX_ANSWER_BYTES * (N as u64 + 1)));
    let mut next_line = || {
        let mut line = String::new();
        lines.read_line(&mut line).map_err(failed)?;
        Ok::<_, String>(line.trim().to_owned())
    };
    // The server greets each client with a line.
    next_line()?;
    let mut answers = [const { String::new() }; N];
    for (command, answer) in std::iter::zip(commands, &mut answers) {
        stream
            .write_all(format!("{command}\n").as_bytes())
            .map_err(failed)?;
        *answer = next_line()?;
    }
    Ok(answers)
}

/// Whether the controller accepts programs from the network. `None` if it does not distinguish
/// local and remote control, as CB3 controllers and early e-Series ones.
pub(super) fn is_in_remote_control(address: &ControllerAddress) -> Result<Option<bool>, String> {
    let [answer] = ask(address, ["is in remote control"])?;
    Ok(match answer.as_str() {
        "true" => Some(true),
        "false" => Some(false),
        _ => None,
    })
}

/// Ends a protective stop, and the program that it interrupted.
///
/// # Errors
/// If the controller refuses. It does so in the first five seconds after the stop.
pub(super) fn unlock_protective_stop(address: &ControllerAddress) -> Result<(), String> {
    const UNLOCKED: &str = "Protective stop releasing";
    // The interrupted program would continue otherwise, if a person presses Play.
    let [_, _, unlocked] = ask(
        address,
        ["stop", "close safety popup", "unlock protective stop"],
    )?;
    if unlocked == UNLOCKED {
        Ok(())
    } else {
        Err(format!("it refuses to end the protective stop: {unlocked}"))
    }
}
