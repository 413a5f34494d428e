//! Addresses of the interfaces of a controller.

use crate::network_address::{NetworkAddress, resolve};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

/// TCP port of RTDE.
pub const RTDE_PORT: u16 = 30004;
/// Maximum time for opening a connection. A controller in the same network responds at once.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);

/// An interface of a controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Interface {
    Rtde,
    /// The secondary client interface, which accepts URScript programs.
    Script,
    /// The dashboard server, which accepts the commands of the pendant's buttons.
    Dashboard,
}

impl Interface {
    /// Ports as on every controller. Source: "Overview of client interfaces" at
    /// docs.universal-robots.com.
    pub(super) fn port(self) -> u16 {
        match self {
            Self::Rtde => RTDE_PORT,
            Self::Script => 30002,
            Self::Dashboard => 29999,
        }
    }
}

/// Host of a controller, and its port of RTDE.
///
/// If the port of RTDE is not 30004, for example because ports are forwarded, the ports of the
/// other interfaces are moved by the same number.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ControllerAddress {
    host: String,
    rtde_port: u16,
}

impl ControllerAddress {
    /// Parses the address of a controller; see [`NetworkAddress::parse`].
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let NetworkAddress { host, port } = NetworkAddress::parse(text)?;
        Ok(Self {
            host,
            rtde_port: port.unwrap_or(RTDE_PORT),
        })
    }

    /// The addresses of an interface.
    pub(super) fn resolve(&self, interface: Interface) -> Result<Vec<SocketAddr>, String> {
        let offset = i32::from(interface.port()) - i32::from(RTDE_PORT);
        let port = u16::try_from(i32::from(self.rtde_port) + offset)
            .map_err(|_| format!("the port {} of RTDE is too small", self.rtde_port))?;
        resolve(&self.host, port)
    }

    /// Connects to an interface.
    pub(super) fn connect(&self, interface: Interface) -> Result<TcpStream, String> {
        let mut failure = String::new();
        for address in self.resolve(interface)? {
            let connected = TcpStream::connect_timeout(&address, CONNECT_TIMEOUT)
                // Setpoints are small, and must not wait for each other.
                .and_then(|stream| stream.set_nodelay(true).map(|()| stream));
            match connected {
                Ok(stream) => return Ok(stream),
                Err(error) => failure = format!("cannot connect to {address}: {error}"),
            }
        }
        Err(failure)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ports_of_the_interfaces_move_together() {
        let port = |text: &str, interface| {
            let address = ControllerAddress::parse(text).unwrap();
            address.resolve(interface).unwrap()[0].port()
        };
        assert_eq!(port("127.0.0.1", Interface::Rtde), 30004);
        assert_eq!(port("127.0.0.1", Interface::Dashboard), 29999);
        assert_eq!(port("127.0.0.1:40004", Interface::Rtde), 40004);
        assert_eq!(port("127.0.0.1:40004", Interface::Script), 40002);
        assert_eq!(port("[::1]:40004", Interface::Dashboard), 39999);
        assert_eq!(port("::1", Interface::Rtde), 30004);
    }

    #[test]
    fn invalid_addresses_are_reported() {
        let error = ControllerAddress::parse("192.168.1").unwrap_err();
        assert!(error.contains("\"192.168.1\""), "{error}");
        let small = ControllerAddress::parse("127.0.0.1:3").unwrap();
        assert!(small.resolve(Interface::Script).is_ok());
        assert!(small.resolve(Interface::Dashboard).is_err());
    }
}
