//! Checks the serial port and the servos of a rig's arm.

use super::Finding;
use crate::config::{ArmDriver, Rig};
use crate::open::servo_config;
use drivers::servos::{ServoArmConfig, ServoBus};
use std::path::Path;
use std::time::Duration;

/// How often a servo that does not answer is asked. An answer that comes late, because the computer
/// or an adapter is busy, counts as missing.
const N_ROUNDS: usize = 4;
const PAUSE: Duration = Duration::from_millis(300);

/// Largest latency of an FTDI adapter that permits the default rate. The adapter holds received
/// bytes for this time, in each exchange.
const MAX_LATENCY_MILLIS: u32 = 4;

/// Checks the latency of the adapter, and pings each servo; empty if the rig has another kind of
/// arm. Nothing moves.
pub(super) fn servos(rig: &Rig) -> Vec<Finding> {
    if !matches!(rig.arm.driver, ArmDriver::Feetech | ArmDriver::Dynamixel) {
        return Vec::new();
    }
    let config = servo_config(rig);
    let latency = latency(Path::new("/sys"), &config.port.device);
    latency.into_iter().chain(ping_all(&config)).collect()
}

/// Pings all servos.
fn ping_all(config: &ServoArmConfig) -> Vec<Finding> {
    let mut bus = match ServoBus::open(&config.port, config.protocol.format()) {
        Ok(bus) => bus,
        Err(error) => {
            let remedy = "list the serial ports with fieldrig devices";
            return vec![Finding::fail("servos", error.to_string(), remedy)];
        }
    };
    let mut silent: Vec<_> = config.servos.iter().collect();
    for round in 0..N_ROUNDS {
        if round > 0 {
            std::thread::sleep(PAUSE);
        }
        silent.retain(|servo| !matches!(bus.ping(servo.id), Ok(Some(_))));
        if silent.is_empty() {
            break;
        }
    }
    let missing: Vec<_> = silent
        .iter()
        .map(|servo| format!("{} (ID {})", servo.joint, servo.id))
        .collect();
    let title = config.protocol.title();
    let device = config.port.device.display();
    if missing.is_empty() {
        let n = config.servos.len();
        let message = format!("{n} {title} servos answer on {device}");
        return vec![Finding::ok("servos", message)];
    }
    let message = format!(
        "no answer on {device} from the servos of {}",
        missing.join(", ")
    );
    let remedy = format!(
        "check the power, the cable, the IDs, and arm.serial.baud_hz, which is {}",
        config.port.baud_hz
    );
    vec![Finding::fail("servos", message, remedy)]
}

/// Checks how long an FTDI adapter holds received bytes. Other adapters have no such setting.
fn latency(sys: &Path, device: &Path) -> Option<Finding> {
    let node = std::fs::canonicalize(device).ok()?;
    let name = node.file_name()?.to_str()?.to_owned();
    let setting = sys
        .join("bus/usb-serial/devices")
        .join(&name)
        .join("latency_timer");
    let millis: u32 = std::fs::read_to_string(&setting)
        .ok()?
        .trim()
        .parse()
        .ok()?;
    if millis <= MAX_LATENCY_MILLIS {
        return Some(Finding::ok(
            "servos",
            format!("{name} has a latency of {millis} ms"),
        ));
    }
    let message = format!(
        "{name} holds received bytes for {millis} ms, so at most {} joint states per second are read",
        1000 / millis
    );
    let remedy = format!("echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer");
    Some(Finding::warn("servos", message, remedy))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use crate::doctor::testing::folder_with;

    #[test]
    fn slow_adapter_is_reported_with_the_command() {
        let device = folder_with("dev/ttyUSB0", "");
        let latency_of = |text: &str| {
            let sys = folder_with("bus/usb-serial/devices/ttyUSB0/latency_timer", text);
            latency(sys.path(), &device.path().join("dev/ttyUSB0")).expect("an FTDI adapter")
        };
        let finding = latency_of("16\n");
        assert_eq!(finding.verdict, Verdict::Warn);
        assert!(
            finding.message.contains("at most 62 joint states"),
            "{finding}"
        );
        assert!(
            finding.to_string().contains("echo 1 | sudo tee"),
            "{finding}"
        );
        assert_eq!(latency_of("1\n").verdict, Verdict::Ok);
        let other = folder_with("dev/ttyACM0", "");
        assert_eq!(
            latency(other.path(), &other.path().join("dev/ttyACM0")),
            None
        );
    }
}
