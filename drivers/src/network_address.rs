//! Addresses of controllers as people write them: a host, and a port if it is not the usual one.

use std::net::{Ipv4Addr, SocketAddr, ToSocketAddrs};

/// A host and a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NetworkAddress {
    /// Name or IP address, without brackets.
    pub host: String,
    /// The port, if it was given.
    pub port: Option<u16>,
}

impl NetworkAddress {
    /// Parses `HOST` or `HOST:PORT`. An IPv6 address with a port is in brackets.
    ///
    /// # Errors
    /// If the host or the port is missing or invalid. The text is a sentence about the address.
    pub fn parse(text: &str) -> Result<Self, String> {
        let (host, port) = match text.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
            Some((host, port)) => (host, port.strip_prefix(':')),
            None if text.matches(':').count() == 1 => {
                let (host, port) = text.split_once(':').unwrap_or((text, ""));
                (host, Some(port))
            }
            None => (text, None),
        };
        let port = port.map(|port| {
            port.parse()
                .map_err(|_| format!("its port {port:?} is not a number up to 65535"))
        });
        check_host(host)?;
        Ok(Self {
            host: host.to_owned(),
            port: port.transpose()?,
        })
    }

    /// The addresses of the host, with this port if the text has none. There is at least one.
    ///
    /// # Errors
    /// If the host is unknown.
    pub fn resolve(&self, default_port: u16) -> Result<Vec<SocketAddr>, String> {
        resolve(&self.host, self.port.unwrap_or(default_port))
    }
}

/// The addresses of a host, at least one.
pub(crate) fn resolve(host: &str, port: u16) -> Result<Vec<SocketAddr>, String> {
    let addresses = (host, port).to_socket_addrs();
    let addresses: Vec<_> = addresses
        .map_err(|error| format!("cannot resolve {host:?}: {error}"))?
        .collect();
    if addresses.is_empty() {
        return Err(format!("{host:?} has no address"));
    }
    Ok(addresses)
}

/// Rejects hosts that are no names and incomplete as IP addresses. The resolver would complete them:
/// for `inet_aton` of the C library, 192.168.1 is 192.168.0.1.
fn check_host(host: &str) -> Result<(), String> {
    if host.is_empty() {
        return Err("it names no host".to_owned());
    }
    let is_number = host
        .chars()
        .all(|letter| letter.is_ascii_digit() || letter == '.');
    if is_number && host.parse::<Ipv4Addr>().is_err() {
        return Err(format!(
            "{host:?} is not a complete IP address, which has four numbers from 0 to 255, such as 192.168.1.10"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_and_ports_are_separated() {
        for (text, host, port) in [
            ("robot", "robot", None),
            ("10.0.0.7", "10.0.0.7", None),
            ("10.0.0.7:40004", "10.0.0.7", Some(40004)),
            ("::1", "::1", None),
            ("[::1]", "::1", None),
            ("[::1]:40004", "::1", Some(40004)),
        ] {
            let address = NetworkAddress::parse(text).expect(text);
            assert_eq!((&*address.host, address.port), (host, port), "{text}");
        }
        let address = NetworkAddress::parse("127.0.0.1").expect("complete");
        let resolved = address.resolve(30004).expect("an IP address");
        assert_eq!(resolved, ["127.0.0.1:30004".parse().expect("an address")]);
    }

    #[test]
    fn incomplete_addresses_are_rejected() {
        for (text, expected) in [
            ("", "no host"),
            (":30004", "no host"),
            ("robot:rtde", "\"rtde\""),
            ("robot:70000", "\"70000\""),
            ("192.168.1", "four numbers"),
            ("192.168.1.", "four numbers"),
            ("192.168.1:30004", "four numbers"),
            ("192.168.1.300", "four numbers"),
            ("192", "four numbers"),
        ] {
            let error = NetworkAddress::parse(text).expect_err(text);
            assert!(error.contains(expected), "{error}");
        }
    }
}
