//! A page that is being served: its addresses, and what is printed about them.

use crate::print;
use anyhow::Context;
use qrcode::QrCode;
use qrcode::render::unicode::Dense1x2;
use serde_json::{Value, json};
use std::io::IsTerminal;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use viz::{Server, Tokens};

/// A page that is being served.
pub(crate) struct ServedPage {
    pub(crate) server: Server,
    /// The data that clients on other machines need, if they may open the page.
    pub(crate) shared: Option<Shared>,
    #[cfg(feature = "foxglove")]
    pub(crate) foxglove: Option<viz::FoxgloveServer>,
}

/// The data that clients of a shared page need.
pub(crate) struct Shared {
    operator_url: String,
    viewer_url: String,
    other_addresses: Vec<IpAddr>,
    fingerprint: String,
    is_self_signed: bool,
}

impl Shared {
    /// The URLs of a page that is served at this address.
    pub(crate) fn new(
        address: SocketAddr,
        tokens: &Tokens,
        fingerprint: String,
        is_self_signed: bool,
    ) -> Self {
        let mut addresses = reachable_addresses(address.ip());
        let url_address = SocketAddr::new(addresses.remove(0), address.port());
        // The token is in the fragment, which browsers send neither to servers nor to other sites.
        let [operator_url, viewer_url] = [&tokens.operator, &tokens.viewer]
            .map(|token| format!("https://{url_address}/#token={}", token.text()));
        Self {
            operator_url,
            viewer_url,
            other_addresses: addresses,
            fingerprint,
            is_self_signed,
        }
    }
}

impl ServedPage {
    /// The address at which the server listens.
    pub(crate) fn address(&self) -> SocketAddr {
        self.server.address()
    }

    /// The address to open in a browser, as operator.
    pub(crate) fn url(&self) -> String {
        self.shared
            .as_ref()
            .map_or_else(|| self.server.url(), |shared| shared.operator_url.clone())
    }

    /// The address to open in Foxglove.
    fn foxglove_url(&self) -> Option<String> {
        #[cfg(feature = "foxglove")]
        return self.foxglove.as_ref().map(viz::FoxgloveServer::url);
        #[cfg(not(feature = "foxglove"))]
        None
    }

    /// Prints the addresses of the page. If `is_json` is set, prints them as an event that also has
    /// these fields.
    pub(crate) fn print(&self, is_json: bool, fields: Value) -> anyhow::Result<()> {
        if is_json {
            self.print_event(fields)
        } else {
            self.print_lines()
        }
    }

    fn print_event(&self, fields: Value) -> anyhow::Result<()> {
        let mut event = json!({ "event": "serving", "url": self.url() });
        if let Some(shared) = &self.shared {
            event["viewer_url"] = json!(shared.viewer_url);
            event["certificate_sha256"] = json!(shared.fingerprint);
        }
        if let Some(url) = self.foxglove_url() {
            event["foxglove_url"] = json!(url);
        }
        if let (Value::Object(event), Value::Object(fields)) = (&mut event, fields) {
            event.extend(fields);
        }
        print::report_json(&event)
    }

    fn print_lines(&self) -> anyhow::Result<()> {
        self.lines().iter().for_each(print::report);
        // The QR code is for phones, which cannot reach a page that only this computer can open.
        if self.shared.is_some() && std::io::stdout().is_terminal() {
            print::report_styled(qr_code(&self.url())?);
        }
        Ok(())
    }

    /// The addresses of the page, and other data that clients need. The addresses contain the
    /// tokens, so they must not be logged.
    pub(crate) fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!("open {} in a browser", self.url())];
        lines.extend(
            self.foxglove_url()
                .map(|url| format!("open the connection {url} in Foxglove")),
        );
        let Some(shared) = &self.shared else {
            return lines;
        };
        lines.push(format!("view-only address: {}", shared.viewer_url));
        if !shared.other_addresses.is_empty() {
            let others: Vec<String> = shared
                .other_addresses
                .iter()
                .map(ToString::to_string)
                .collect();
            lines.push(format!(
                "other addresses of this computer: {}",
                others.join(", ")
            ));
        }
        let remark = if shared.is_self_signed {
            " (self-signed: the browser warns once; compare this value first)"
        } else {
            ""
        };
        lines.push(format!(
            "certificate SHA-256: {}{remark}",
            shared.fingerprint
        ));
        lines
    }
}

/// The addresses at which other machines may reach a server, most likely first. There is at least
/// one address.
fn reachable_addresses(listen: IpAddr) -> Vec<IpAddr> {
    if !listen.is_unspecified() {
        return vec![listen];
    }
    // Without the list, the page still works on this computer, so an error is only a warning.
    let interfaces = if_addrs::get_if_addrs().unwrap_or_else(|error| {
        log::warn!("cannot list the network addresses of this computer: {error}");
        Vec::new()
    });
    let mut addresses: Vec<IpAddr> = interfaces
        .iter()
        .filter(|interface| !interface.is_loopback() && !interface.is_link_local())
        .map(|interface| interface.ip())
        .filter(|address| address.is_ipv4() || listen.is_ipv6())
        .collect();
    // The network with the default route is likely the one on which viewers are.
    let default = default_route_address();
    addresses.sort_by_key(|address| (Some(*address) != default, address.is_ipv6()));
    // Without a network, only this computer can open the page.
    if addresses.is_empty() {
        addresses.push(if listen.is_ipv4() {
            Ipv4Addr::LOCALHOST.into()
        } else {
            Ipv6Addr::LOCALHOST.into()
        });
    }
    addresses
}

/// This computer's address on the network with the default route, if there is one. No data is sent.
fn default_route_address() -> Option<IpAddr> {
    // Connecting a UDP socket sends nothing, but lets the kernel choose the address of the route.
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).ok()?;
    // An address for documentation (RFC 5737), which no network uses.
    socket.connect((Ipv4Addr::new(192, 0, 2, 1), 9)).ok()?;
    socket.local_addr().ok().map(|address| address.ip())
}

/// A QR code for terminals. It is dark on light, independent of the terminal's colors.
fn qr_code(text: &str) -> anyhow::Result<String> {
    let code = QrCode::new(text).context("cannot create a QR code")?;
    let lines = code.render::<Dense1x2>().build();
    Ok(lines
        .lines()
        .map(|line| format!("\x1b[30;107m{line}\x1b[0m"))
        .collect::<Vec<_>>()
        .join("\n"))
}
