//! Notices that nothing arrives at a port, and names the programs that could send something.

use crate::device_names;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// A silence of this length is reported. Senders send at least ten datagrams per second, and the
/// report comes before a silent device ends a run.
const MAX_QUIET: Duration = Duration::from_secs(2);

/// The time in which nothing has arrived.
#[derive(Debug, Default)]
pub(crate) struct Silence {
    began: Option<Instant>,
    is_reported: bool,
}

impl Silence {
    /// A datagram has arrived.
    pub(crate) fn end(&mut self) {
        *self = Self::default();
    }

    /// Whether the silence has become too long. Returns true once per silence, which begins with the
    /// first call.
    pub(crate) fn is_news(&mut self, now: Instant) -> bool {
        let began = *self.began.get_or_insert(now);
        let is_long = now.saturating_duration_since(began) >= MAX_QUIET;
        is_long && !std::mem::replace(&mut self.is_reported, true)
    }
}

/// What to do about a silent device.
pub(crate) fn advice(device: &str, address: SocketAddr) -> String {
    let (data, sender) = match device {
        device_names::ARM => ("joint states", Some("ros2_joints.py")),
        device_names::BASE => ("poses", Some("ros2_base.py")),
        _ => ("scans", None),
    };
    let to = if address.ip().is_unspecified() {
        format!("ADDRESS_OF_THIS_COMPUTER:{}", address.port())
    } else {
        address.to_string()
    };
    let example = sender.map_or(String::new(), |sender| {
        format!(", such as scripts/senders/{sender} --to {to}")
    });
    format!(
        "{device}: nothing arrives at UDP port {}: start the program that sends {data} to {to}{example} (format: docs/reference/udp.md)",
        address.port()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_silence_is_news_once() {
        let start = Instant::now();
        let at = |millis: u64| start + Duration::from_millis(millis);
        let mut silence = Silence::default();
        assert!(!silence.is_news(at(0)) && !silence.is_news(at(1900)));
        assert!(silence.is_news(at(2000)) && !silence.is_news(at(9000)));
        silence.end();
        assert!(!silence.is_news(at(10_000)) && silence.is_news(at(12_000)));
    }

    #[test]
    fn port_and_sender_are_named() {
        let address = |text: &str| text.parse().expect("an address");
        assert_eq!(
            advice(device_names::BASE, address("127.0.0.1:7009")),
            "base: nothing arrives at UDP port 7009: start the program that sends poses to 127.0.0.1:7009, such as \
             scripts/senders/ros2_base.py --to 127.0.0.1:7009 (format: docs/reference/udp.md)"
        );
        let text = advice("range scanner \"lidar\"", address("0.0.0.0:7010"));
        assert!(
            text.contains("sends scans to ADDRESS_OF_THIS_COMPUTER:7010 (format"),
            "{text}"
        );
    }
}
