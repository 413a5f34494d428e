//! Checks this computer and the network for a rig with a Franka arm, without occupying the robot's
//! only client connection.

use super::{Finding, Verdict, field};
use crate::config::{ArmDriver, Rig};
use crate::open::FCI_PORT;
use drivers::NetworkAddress;
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

/// Maximum ping time. Franka requires that a response reaches the robot within 1 ms of the state.
const MAX_PING_MILLIS: f64 = 1.0;
/// Maximum time for opening a connection. A controller in the same network responds at once.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(1);
/// Number of pings, five per second.
const N_PINGS: &str = "10";

/// Checks kernel, limits and network; empty if the rig has another kind of arm.
pub(super) fn franka(rig: Option<&Rig>) -> Vec<Finding> {
    let Some(arm) = rig
        .map(|rig| &rig.arm)
        .filter(|arm| arm.driver == ArmDriver::Franka)
    else {
        return Vec::new();
    };
    let os_release = std::fs::read_to_string("/etc/os-release").unwrap_or_default();
    let mut findings = vec![
        kernel(Path::new("/sys"), &os_release),
        locked_memory(Path::new("/proc")),
    ];
    if arm.address.is_empty() {
        let remedy = "set arm.address in the rig file, such as \"172.16.0.2\"; Desk shows it under Settings, Network";
        findings.push(Finding::fail("robot", "arm.address is missing", remedy));
        return findings;
    }
    let address = match NetworkAddress::parse(&arm.address) {
        Ok(address) => address,
        Err(reason) => {
            let remedy = "Desk shows the address of the robot under Settings, Network";
            let message = format!("arm.address is {:?}: {reason}", arm.address);
            findings.push(Finding::fail("robot", message, remedy));
            return findings;
        }
    };
    let host = &*address.host;
    findings.extend(
        output_of("ip", &["-o", "route", "get", host])
            .map(|command_output| route(Path::new("/sys"), host, &command_output)),
    );
    let pinged = match output_of(
        "ping",
        &["-n", "-q", "-i", "0.2", "-W", "1", "-c", N_PINGS, host],
    ) {
        Some(command_output) => pings(host, &command_output),
        None => {
            let remedy = "sudo apt-get install -y iputils-ping";
            Finding::warn(
                "robot",
                format!("cannot check whether {host} responds: ping is not installed"),
                remedy,
            )
        }
    };
    // A connection to a host that does not respond would only wait for its timeout and report the
    // same problem again.
    let is_reachable = pinged.verdict != Verdict::Fail;
    findings.push(pinged);
    findings.extend(is_reachable.then(|| port(&arm.address, &address)));
    findings
}

/// The output of a program; `None` if it is not installed.
fn output_of(program: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).output().ok()?;
    Some(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Checks that the controller accepts clients. It opens a connection and closes it without sending
/// anything, so the robot is not occupied.
fn port(text: &str, address: &NetworkAddress) -> Finding {
    let connected = address.resolve(FCI_PORT).and_then(|all| {
        TcpStream::connect_timeout(&all[0], CONNECT_TIMEOUT).map_err(|error| error.to_string())
    });
    match connected {
        Ok(_) => Finding::ok("FCI", format!("{text} accepts clients")),
        Err(error) => {
            let remedy =
                "activate FCI in Desk and unlock the joints; the robot must have the FCI feature";
            Finding::fail("FCI", format!("{text} accepts no client: {error}"), remedy)
        }
    }
}

fn kernel(sys: &Path, os_release: &str) -> Finding {
    let is_realtime =
        std::fs::read_to_string(sys.join("kernel/realtime")).is_ok_and(|text| text.trim() == "1");
    if is_realtime {
        return Finding::ok("kernel", "PREEMPT_RT");
    }
    let remedy = if os_release.lines().any(|line| line == "ID=ubuntu") {
        "sudo pro enable realtime-kernel, then boot into it"
    } else {
        "sudo apt-get install -y linux-image-rt-amd64, then boot into it"
    };
    Finding::warn(
        "kernel",
        "without PREEMPT_RT: states at 1 kHz are sometimes read some ms late",
        remedy,
    )
}

/// Checks how much memory this user may lock.
fn locked_memory(proc: &Path) -> Finding {
    match field(&proc.join("self/limits"), "Max locked memory").as_deref() {
        None => Finding::ok("memory lock", "not reported by the kernel"),
        Some("unlimited") => Finding::ok("memory lock", "unlimited"),
        Some(bytes) => {
            let message = format!(
                "at most {bytes} bytes may be locked: the arm's thread may have to wait for the disk"
            );
            let remedy = r#"echo "$USER - memlock unlimited" | sudo tee -a /etc/security/limits.conf, then log in again"#;
            Finding::warn("memory lock", message, remedy)
        }
    }
}

/// Checks the route to the robot in the output of `ip -o route get`.
fn route(sys: &Path, host: &str, command_output: &str) -> Finding {
    let Some(interface) = word_after(command_output, "dev") else {
        let remedy = "sudo ip addr add 172.16.0.1/24 dev INTERFACE   (the interface with the robot's cable; an unused address in the robot's network)";
        return Finding::fail("route", format!("no route to {host}"), remedy);
    };
    if sys
        .join("class/net")
        .join(interface)
        .join("wireless")
        .exists()
    {
        let message = format!(
            "{host} is reached via {interface}, a wireless network: states arrive late or get lost"
        );
        return Finding::warn(
            "route",
            message,
            "connect the robot's cable to this computer",
        );
    }
    match word_after(command_output, "via") {
        Some(router) => {
            let message = format!("{host} is reached via the router {router} ({interface})");
            Finding::warn(
                "route",
                message,
                "connect the robot's cable to this computer, in a separate network",
            )
        }
        None => Finding::ok("route", format!("{host} is on {interface}")),
    }
}

/// The word that follows a keyword.
fn word_after<'a>(text: &'a str, keyword: &str) -> Option<&'a str> {
    text.split_whitespace()
        .skip_while(|found| *found != keyword)
        .nth(1)
}

/// Checks response and latency of the robot in the output of `ping -q`.
fn pings(host: &str, command_output: &str) -> Finding {
    let loss_percent: Option<f64> = command_output
        .split_once("% packet loss")
        .and_then(|(before, _)| before.split_whitespace().last()?.parse().ok());
    let times = command_output
        .split_once("mdev = ")
        .and_then(|(_, times)| times.split_whitespace().next());
    let times: Option<Vec<f64>> =
        times.and_then(|times| times.split('/').map(|time| time.parse().ok()).collect());
    let latency_remedy = "connect without a switch; sudo ethtool -C INTERFACE rx-usecs 0; use the governor performance";
    match (loss_percent, times.as_deref()) {
        (Some(loss_percent), Some([_, average, max_millis, ..])) => {
            let message = format!(
                "{host} responds after {average} ms, at most {max_millis} ms; {loss_percent} % of pings are lost"
            );
            if loss_percent > 0.0 || *max_millis > MAX_PING_MILLIS {
                return Finding::warn("robot", message, latency_remedy);
            }
            Finding::ok("robot", message)
        }
        _ => {
            let remedy = "check the cable and the robot's lights; Desk shows its address under Settings, Network";
            Finding::fail("robot", format!("{host} does not respond"), remedy)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn controller_connection_is_checked() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("bound").to_string();
        let parsed = NetworkAddress::parse(&address).expect("complete");
        assert_eq!(port(&address, &parsed).verdict, Verdict::Ok);
        drop(listener);
        let finding = port(&address, &parsed);
        assert!(
            finding.message.contains(&address)
                && finding.remedy.is_some_and(|remedy| remedy.contains("Desk"))
        );
    }

    #[test]
    fn kernel_and_limits_are_reported_with_remedies() {
        let folder = tempfile::tempdir().expect("a folder");
        for (name, text) in [
            ("kernel/realtime", "1\n"),
            (
                "self/limits",
                "Max locked memory  8388608  8388608  bytes\n",
            ),
        ] {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().expect("inside the folder"))
                .expect("the folder is writable");
            std::fs::write(path, text).expect("the folder is writable");
        }
        assert_eq!(kernel(folder.path(), "").verdict, Verdict::Ok);
        for (os_release, remedy) in [
            ("ID=ubuntu\n", "pro enable"),
            ("ID=debian\n", "linux-image-rt"),
        ] {
            let finding = kernel(Path::new("/nowhere"), os_release);
            assert_eq!(finding.verdict, Verdict::Warn);
            assert!(finding.remedy.expect("a remedy").contains(remedy));
        }
        let finding = locked_memory(folder.path());
        assert!(
            finding.message.contains("8388608")
                && finding.remedy.expect("a remedy").contains("memlock")
        );
        std::fs::write(
            folder.path().join("self/limits"),
            "Max locked memory  unlimited  unlimited  bytes\n",
        )
        .expect("the folder is writable");
        assert_eq!(locked_memory(folder.path()).verdict, Verdict::Ok);
    }

    #[test]
    fn route_to_the_robot_is_checked() {
        let sys = tempfile::tempdir().expect("a folder");
        std::fs::create_dir_all(sys.path().join("class/net/wlan0/wireless"))
            .expect("the folder is writable");
        let route_finding = |command_output: &str| route(sys.path(), "172.16.0.2", command_output);
        let direct = route_finding("172.16.0.2 dev eth0 src 172.16.0.1 uid 0 \\    cache ");
        assert_eq!(
            (direct.verdict, direct.message.contains("eth0")),
            (Verdict::Ok, true)
        );
        let routed =
            route_finding("172.16.0.2 via 10.0.0.1 dev eth0 src 10.0.0.7 uid 0 \\    cache ");
        assert_eq!(
            (routed.verdict, routed.message.contains("10.0.0.1")),
            (Verdict::Warn, true)
        );
        assert!(
            route_finding("172.16.0.2 dev wlan0 src 172.16.0.1")
                .message
                .contains("wireless")
        );
        assert_eq!(route_finding("").verdict, Verdict::Fail);
    }

    #[test]
    fn ping_check_uses_loss_and_max_latency() {
        let command_output = |loss: &str, max_millis: &str| {
            format!(
                "PING 172.16.0.2 (172.16.0.2) 56(84) bytes of data.\n\n--- 172.16.0.2 ping statistics ---\n10 packets transmitted, \
                 10 received, {loss}% packet loss, time 1835ms\nrtt min/avg/max/mdev = 0.101/0.150/{max_millis}/0.020 ms\n"
            )
        };
        let verdict = |command_output: &str| pings("172.16.0.2", command_output).verdict;
        assert_eq!(verdict(&command_output("0", "0.300")), Verdict::Ok);
        assert_eq!(verdict(&command_output("0", "1.300")), Verdict::Warn);
        assert_eq!(verdict(&command_output("10", "0.300")), Verdict::Warn);
        assert_eq!(
            verdict("10 packets transmitted, 0 received, 100% packet loss, time 9000ms\n"),
            Verdict::Fail
        );
        assert_eq!(verdict(""), Verdict::Fail);
    }
}
