//! Checks the UDP addresses on which a rig listens.

use super::Finding;
use crate::config::{ArmDriver, BaseDriver, Rig, ScannerDriver};
use crate::open;
use std::net::UdpSocket;

/// Checks that no other program uses the UDP addresses of the rig.
pub(super) fn senders(rig: &Rig) -> Vec<Finding> {
    let base = (rig.base.driver == BaseDriver::Udp).then(|| ("base".to_owned(), rig.base.address));
    let scanners = rig.scanners.iter().filter(|scanner| scanner.driver == ScannerDriver::Udp);
    let scanners = scanners.map(|scanner| (format!("range scanner {:?}", scanner.name), scanner.address));
    let arm = (rig.arm.driver == ArmDriver::Udp).then(|| open::udp_arm_address(rig));
    let (arm, invalid) = match arm {
        Some(Ok(address)) => (Some(("arm".to_owned(), address)), None),
        Some(Err(error)) => {
            (None, Some(Finding::fail("udp", format!("{error:#}"), "arm.address = \"127.0.0.1:7011\"")))
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use crate::doctor::testing::bundled_rig;

    #[test]
    fn occupied_addresses_are_reported() {
        let occupied = UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let address = occupied.local_addr().expect("bound").to_string();
        let rig = bundled_rig("static-arm.toml", &[("base.driver", "udp"), ("base.address", &address)]);
        let verdicts = || senders(&rig).iter().map(|finding| finding.verdict).collect::<Vec<_>>();
        assert_eq!(verdicts(), [Verdict::Fail]);
        drop(occupied);
        assert_eq!(verdicts(), [Verdict::Ok]);
    }

    #[test]
    fn invalid_address_is_reported() {
        let findings = senders(&bundled_rig("static-arm.toml", &[("arm.driver", "udp"), ("arm.address", "localhost")]));
        assert!(findings.len() == 1 && findings[0].message.contains("arm.address is \"localhost\""), "{findings:?}");
    }
}
