//! Serves the page of a program, and describes its addresses.

use crate::server::access::Tokens;
use crate::server::certificate::Certificate;
use crate::server::{Server, ServerConfig, Sharing};
use crate::{Error, Hub};
use serde_json::{Value, json};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::path::PathBuf;

/// Address of the page, and the clients that may open it.
#[derive(Clone, Debug, Default)]
pub struct PageOptions {
    /// Address of the page. `None`: the default address.
    pub listen: Option<SocketAddr>,
    /// The certificate for clients on other machines. `None`: only this computer can open the page.
    pub shared_with: Option<CertificateSource>,
    /// Loopback address at which Foxglove gets the same data.
    pub foxglove: Option<SocketAddr>,
}

/// Where the certificate of a shared page comes from.
#[derive(Clone, Debug)]
pub enum CertificateSource {
    /// Files in PEM format.
    Files {
        /// The certificate with its chain.
        certificate: PathBuf,
        /// Its private key.
        key: PathBuf,
    },
    /// A self-signed certificate in this folder. It is created if there is none, and kept, so that
    /// browsers which have accepted it do not warn at the next run.
    KeptIn(PathBuf),
}

/// A page that is being served.
pub struct ServedPage {
    server: Server,
    /// The data that clients on other machines need, if they may open the page.
    shared: Option<Shared>,
    #[cfg(feature = "foxglove")]
    foxglove: Option<crate::FoxgloveServer>,
}

/// The data that clients of a shared page need.
struct Shared {
    operator_url: String,
    viewer_url: String,
    other_addresses: Vec<IpAddr>,
    fingerprint: String,
    is_self_signed: bool,
}

impl PageOptions {
    /// Rejects options that this build lacks.
    ///
    /// # Errors
    ///
    /// If Foxglove is requested from a build without it.
    pub fn check(&self) -> Result<(), Error> {
        if self.foxglove.is_some() && !cfg!(feature = "foxglove") {
            return Err(Error::FoxgloveNotBuilt);
        }
        Ok(())
    }

    /// Serves the page.
    ///
    /// # Errors
    ///
    /// If the address or the certificate cannot be used.
    pub fn serve(&self, hub: &Hub) -> Result<ServedPage, Error> {
        self.check()?;
        self.serve_at(self.listen.unwrap_or_else(|| self.default_address()), hub)
    }

    /// Serves the page; if the default address is in use, at a free port.
    ///
    /// # Errors
    ///
    /// If the address or the certificate cannot be used.
    pub fn serve_or_free_port(&self, hub: &Hub) -> Result<ServedPage, Error> {
        // A user who gives an address expects the page there. The default address is only a
        // proposal.
        match self.serve(hub) {
            Err(Error::AddressInUse { address }) if self.listen.is_none() => {
                log::info!("{address} is in use by another program; using a free port");
                self.serve_at(SocketAddr::new(address.ip(), 0), hub)
            }
            served => served,
        }
    }

    fn default_address(&self) -> SocketAddr {
        let ServerConfig { mut listen } = ServerConfig::default();
        // The default address can only be reached from this computer.
        if self.shared_with.is_some() {
            listen.set_ip(Ipv4Addr::UNSPECIFIED.into());
        }
        listen
    }

    fn serve_at(&self, listen: SocketAddr, hub: &Hub) -> Result<ServedPage, Error> {
        let config = ServerConfig { listen };
        let (server, shared) = match &self.shared_with {
            Some(source) => {
                let (server, shared) = share_at(config, source, hub)?;
                (server, Some(shared))
            }
            None => (Server::start(config, hub.clone())?, None),
        };
        Ok(ServedPage {
            server,
            shared,
            #[cfg(feature = "foxglove")]
            foxglove: self
                .foxglove
                .map(|address| crate::FoxgloveServer::start(address, hub.clone()))
                .transpose()?,
        })
    }
}

fn share_at(
    config: ServerConfig,
    source: &CertificateSource,
    hub: &Hub,
) -> Result<(Server, Shared), Error> {
    let certificate = match source {
        CertificateSource::Files { certificate, key } => Certificate::read(certificate, key)?,
        CertificateSource::KeptIn(folder) => Certificate::kept_in(folder)?,
    };
    let tokens = Tokens::random().map_err(|source| Error::Token { source })?;
    let fingerprint = certificate.fingerprint();
    let is_self_signed = matches!(source, CertificateSource::KeptIn(_));
    let server = Server::start_shared(
        config,
        Sharing {
            certificate,
            tokens: tokens.clone(),
        },
        hub.clone(),
    )?;
    let shared = Shared::new(server.address(), &tokens, fingerprint, is_self_signed);
    Ok((server, shared))
}

impl Shared {
    /// The URLs of a page that is served at this address.
    fn new(
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
    pub fn address(&self) -> SocketAddr {
        self.server.address()
    }

    /// The address to open in a browser, as operator.
    pub fn url(&self) -> String {
        self.shared
            .as_ref()
            .map_or_else(|| self.server.url(), |shared| shared.operator_url.clone())
    }

    /// The address to open in Foxglove.
    fn foxglove_url(&self) -> Option<String> {
        #[cfg(feature = "foxglove")]
        return self.foxglove.as_ref().map(crate::FoxgloveServer::url);
        #[cfg(not(feature = "foxglove"))]
        None
    }

    /// Whether other machines may open the page.
    pub fn is_shared(&self) -> bool {
        self.shared.is_some()
    }

    /// The addresses of the page, and other data that clients need, as JSON.
    pub fn event(&self) -> Value {
        let mut event = json!({ "event": "serving", "url": self.url() });
        if let Some(shared) = &self.shared {
            event["viewer_url"] = json!(shared.viewer_url);
            event["certificate_sha256"] = json!(shared.fingerprint);
        }
        if let Some(url) = self.foxglove_url() {
            event["foxglove_url"] = json!(url);
        }
        event
    }

    /// The addresses of the page, and other data that clients need. The addresses contain the
    /// tokens, so they must not be logged.
    pub fn lines(&self) -> Vec<String> {
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
