//! Checks the UDP addresses on which a rig listens, and the datagrams that arrive there.

use super::Finding;
use crate::config::{ArmDriver, BaseDriver, Rig, ScannerDriver};
use crate::open;
use drivers::device_names;
use drivers::udp::{DatagramCounts, DatagramMonitor};
use std::net::UdpSocket;

/// Checks that no other program uses the UDP addresses of the rig.
pub(super) fn senders(rig: &Rig) -> Vec<Finding> {
    let base = (rig.base.driver == BaseDriver::Udp)
        .then(|| (device_names::BASE.to_owned(), rig.base.address));
    let scanners = rig
        .scanners
        .iter()
        .filter(|scanner| scanner.driver == ScannerDriver::Udp);
    let scanners =
        scanners.map(|scanner| (device_names::range_scanner(&scanner.name), scanner.address));
    let arm = (rig.arm.driver == ArmDriver::Udp).then(|| open::udp_arm_address(rig));
    let (arm, invalid) = match arm {
        Some(Ok(address)) => (Some((device_names::ARM.to_owned(), address)), None),
        Some(Err(error)) => (
            None,
            Some(Finding::fail(
                "udp",
                format!("{error:#}"),
                "arm.address = \"127.0.0.1:7011\"",
            )),
        ),
        None => (None, None),
    };
    let addresses = base.into_iter().chain(arm).chain(scanners);
    let findings = addresses
        .map(|(device, address)| match UdpSocket::bind(address) {
            Ok(_) => Finding::ok("udp", format!("{device}: {address} is free to listen on")),
            Err(error) => {
                let message = format!("{device}: {address}: {error}");
                Finding::fail(
                    "udp",
                    message,
                    "another program listens there, perhaps another fieldrig: stop it, or choose another address",
                )
            }
        })
        .chain(invalid);
    findings.collect()
}

/// Checks the datagrams of a device that was read. `None` if there is no problem, or if no datagram
/// arrived.
///
/// * `has_data`: whether the device delivered any data.
pub(super) fn received(monitor: &DatagramMonitor, has_data: bool) -> Option<Finding> {
    finding(
        monitor.device(),
        &monitor.counts(),
        &reason(monitor, has_data),
        has_data,
    )
}

/// Why datagrams were not used, as the end of a sentence; may be empty.
fn reason(monitor: &DatagramMonitor, has_data: bool) -> String {
    match (monitor.last_rejection(), monitor.unmatched_names()) {
        (Some(reason), _) => format!("; the last rejection: {reason}"),
        // Beside states of the arm, states of other joints are expected.
        (None, Some(names)) if !has_data => format!("; {names}"),
        _ => String::new(),
    }
}

fn finding(device: &str, counts: &DatagramCounts, reason: &str, has_data: bool) -> Option<Finding> {
    let DatagramCounts {
        n_received,
        n_rejected,
        n_foreign,
        n_other,
        n_uncertain,
        n_late,
        ..
    } = *counts;
    let unused = [
        (n_rejected, "rejected"),
        (n_foreign, "from another sender"),
        (n_other, "without any joint of the arm"),
        (n_uncertain, "too uncertain"),
        (n_late, "late or duplicate"),
    ];
    let listed: Vec<String> = unused
        .iter()
        .filter(|(n, _)| *n > 0)
        .map(|(n, what)| format!("{n} {what}"))
        .collect();
    let listed = listed.join(", ");
    let remedy = match (n_rejected, n_foreign, n_other, n_uncertain) {
        (0, 0, 1.., _) => "correct arm.joints, or the joint names that the sender uses",
        (0, 0, 0, 1..) => {
            "raise base.max_sigma_m and base.max_sigma_rad, or improve the localization"
        }
        (0, 1.., _, _) => "stop one of the senders, and let the other one keep its socket",
        _ => "correct the sender: docs/reference/udp.md describes the format",
    };
    // States of other joints are no problem if states of the arm arrive as well.
    let is_problem = n_rejected + n_foreign + n_uncertain > 0;
    match (n_received, has_data) {
        (0, _) => None,
        (_, false) => {
            let message =
                format!("{device}: none of {n_received} datagrams can be used: {listed}{reason}");
            Some(Finding::fail("udp", message, remedy))
        }
        (_, true) if is_problem => {
            let message = format!(
                "{device}: some of {n_received} datagrams cannot be used: {listed}{reason}"
            );
            Some(Finding::warn("udp", message, remedy))
        }
        (_, true) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use crate::doctor::testing::bundled_rig;

    #[test]
    fn occupied_addresses_are_reported() {
        let occupied = UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let address = occupied.local_addr().expect("bound").to_string();
        let rig = bundled_rig(
            "static-arm.toml",
            &[("base.driver", "udp"), ("base.address", &address)],
        );
        let verdicts = || {
            senders(&rig)
                .iter()
                .map(|finding| finding.verdict)
                .collect::<Vec<_>>()
        };
        assert_eq!(verdicts(), [Verdict::Fail]);
        drop(occupied);
        assert_eq!(verdicts(), [Verdict::Ok]);
    }

    #[test]
    fn unusable_datagrams_are_reported_with_their_cause() {
        let none = DatagramCounts::default();
        let of = |counts, reason, has_data| finding("arm", &counts, reason, has_data);
        assert_eq!(
            of(none, "", false),
            None,
            "a silent device has another finding"
        );
        assert_eq!(
            of(
                DatagramCounts {
                    n_received: 9,
                    n_other: 4,
                    n_late: 1,
                    ..none
                },
                "",
                true
            ),
            None
        );
        for (counts, words) in [
            (
                DatagramCounts {
                    n_rejected: 9,
                    ..none
                },
                ["9 rejected; the last rejection: version is 2", "udp.md"],
            ),
            (
                DatagramCounts { n_other: 9, ..none },
                [
                    "9 without any joint of the arm; names has left, and",
                    "correct arm.joints",
                ],
            ),
            (
                DatagramCounts {
                    n_foreign: 8,
                    n_late: 1,
                    ..none
                },
                ["8 from another sender, 1 late", "stop one"],
            ),
            (
                DatagramCounts {
                    n_uncertain: 9,
                    ..none
                },
                ["9 too uncertain", "base.max_sigma_m"],
            ),
        ] {
            let reason = match (counts.n_rejected, counts.n_other) {
                (1.., _) => "; the last rejection: version is 2",
                (_, 1..) => "; names has left, and arm.joints has a, b",
                _ => "",
            };
            let counts = DatagramCounts {
                n_received: 9,
                ..counts
            };
            let finding = of(counts, reason, false).expect("no datagram is usable");
            assert_eq!(finding.verdict, Verdict::Fail, "{finding:?}");
            let text = finding.to_string();
            assert!(
                text.starts_with("arm: none of 9") && words.iter().all(|word| text.contains(word)),
                "{text}"
            );
            let some = of(
                DatagramCounts {
                    n_received: 900,
                    ..counts
                },
                reason,
                true,
            );
            let is_reported = some.is_some_and(|finding| finding.verdict == Verdict::Warn);
            assert_eq!(
                is_reported,
                counts.n_other == 0,
                "states of other joints are no problem"
            );
        }
    }

    #[test]
    fn invalid_address_is_reported() {
        let findings = senders(&bundled_rig(
            "static-arm.toml",
            &[("arm.driver", "udp"), ("arm.address", "localhost")],
        ));
        assert!(
            findings.len() == 1 && findings[0].message.contains("arm.address is \"localhost\""),
            "{findings:?}"
        );
    }
}
