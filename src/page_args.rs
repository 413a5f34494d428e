//! Flags for the address of the page, and what is printed about it.

use crate::exit::BadArgument;
use crate::print;
use anyhow::Context;
use qrcode::QrCode;
use qrcode::render::unicode::Dense1x2;
use serde_json::{Value, json};
use session::next_commands::quoted;
use std::io::IsTerminal;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::path::PathBuf;
use viz::{Certificate, Hub, Server, ServerConfig, Sharing, Token, Tokens};

/// Where the page is served, and to whom.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct PageArgs {
    /// Address of the page: numeric IP address and port [default: 127.0.0.1:7007, with --share 0.0.0.0:7007; `view`
    /// takes a free port if that one is in use]
    #[arg(long, value_name = "ADDRESS", value_parser = address)]
    listen: Option<SocketAddr>,
    /// Let other machines open the page: encrypted, and only with a token, which is part of the printed addresses
    #[arg(long)]
    share: bool,
    /// TLS certificate for --share, with its chain (PEM) [default: self-signed, kept for later runs]
    #[arg(long, value_name = "FILE", requires = "share")]
    certificate: Option<PathBuf>,
    /// Private key of --certificate (PEM) [default: it is in the same file]
    #[arg(long, value_name = "FILE", requires = "certificate")]
    certificate_key: Option<PathBuf>,
}

/// Parses the address of the page.
fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| "expected an address and a port, such as 127.0.0.1:7007".to_owned())
}

impl PageArgs {
    /// Rejects an address that other machines can reach, unless the page is shared.
    pub(crate) fn check(&self) -> Result<(), BadArgument> {
        match self.listen {
            Some(address) if !address.ip().is_loopback() && !self.share => {
                let command: Vec<String> = std::env::args().skip(1).map(|word| quoted(&word)).collect();
                Err(BadArgument(format!(
                    "other machines can reach {address}, so the page must be encrypted and require a token: run \
                     `fieldrig {} --share`",
                    command.join(" ")
                )))
            }
            _ => Ok(()),
        }
    }

    /// Serves the page.
    pub(crate) fn serve(&self, hub: &Hub) -> anyhow::Result<ServedPage> {
        self.serve_at(self.listen.unwrap_or_else(|| self.default_address()), hub)
    }

    /// Serves the page; if the default address is in use, at a free port.
    pub(crate) fn serve_or_free_port(&self, hub: &Hub) -> anyhow::Result<ServedPage> {
        let served = self.serve(hub);
        match served.as_ref().map_err(|error| error.downcast_ref()) {
            Err(Some(viz::Error::AddressInUse { address })) if self.listen.is_none() => {
                log::info!("{address} is in use by another program; using a free port");
                self.serve_at(SocketAddr::new(address.ip(), 0), hub)
            }
            _ => served,
        }
    }

    fn default_address(&self) -> SocketAddr {
        let ServerConfig { mut listen } = ServerConfig::default();
        if self.share {
            listen.set_ip(Ipv4Addr::UNSPECIFIED.into());
        }
        listen
    }

    fn serve_at(&self, listen: SocketAddr, hub: &Hub) -> anyhow::Result<ServedPage> {
        let config = ServerConfig { listen };
        let (server, shared) = if self.share {
            let (server, shared) = self.share_at(config, hub)?;
            (server, Some(shared))
        } else {
            (Server::start(config, hub.clone())?, None)
        };
        Ok(ServedPage { server, shared })
    }

    fn share_at(&self, config: ServerConfig, hub: &Hub) -> anyhow::Result<(Server, Shared)> {
        let certificate = match &self.certificate {
            Some(file) => Certificate::read(file, self.certificate_key.as_ref().unwrap_or(file))?,
            None => Certificate::kept_in(&data_folder()?)?,
        };
        let tokens = Tokens::random().context("cannot create a token")?;
        let shared = Shared {
            tokens: tokens.clone(),
            fingerprint: certificate.fingerprint(),
            is_self_signed: self.certificate.is_none(),
        };
        Ok((Server::start_shared(config, Sharing { certificate, tokens }, hub.clone())?, shared))
    }
}

/// The user's folder for data of this program.
fn data_folder() -> Result<PathBuf, BadArgument> {
    let given = std::env::var_os("XDG_DATA_HOME").map(PathBuf::from).filter(|folder| folder.is_absolute());
    let in_home = || Some(std::env::home_dir()?.join(".local/share"));
    given.or_else(in_home).map(|folder| folder.join("fieldrig")).ok_or_else(|| {
        BadArgument("there is no home folder for the TLS certificate: set HOME, or use --certificate".to_owned())
    })
}

/// A page that is being served.
pub(crate) struct ServedPage {
    server: Server,
    shared: Option<Shared>,
}

/// What clients of a shared page need to know.
struct Shared {
    tokens: Tokens,
    fingerprint: String,
    is_self_signed: bool,
}

impl ServedPage {
    /// The address at which the server listens.
    pub(crate) fn address(&self) -> SocketAddr {
        self.server.address()
    }

    /// The address to open in a browser, as operator.
    pub(crate) fn url(&self) -> String {
        match &self.shared {
            None => self.server.url(),
            Some(shared) => shared_url(self.reachable_addresses()[0], self.address().port(), &shared.tokens.operator),
        }
    }

    /// Prints the addresses to open in a browser, as an event with these `fields` if `is_json`.
    pub(crate) fn print(&self, is_json: bool, fields: Value) -> anyhow::Result<()> {
        let url = self.url();
        let viewer_url = self
            .shared
            .as_ref()
            .map(|shared| shared_url(self.reachable_addresses()[0], self.address().port(), &shared.tokens.viewer));
        if is_json {
            let mut event = json!({ "event": "serving", "url": url });
            if let (Some(shared), Some(viewer_url)) = (&self.shared, viewer_url) {
                event["viewer_url"] = json!(viewer_url);
                event["certificate_sha256"] = json!(shared.fingerprint);
            }
            if let (Value::Object(event), Value::Object(fields)) = (&mut event, fields) {
                event.extend(fields);
            }
            return print::report_json(&event);
        }
        print::report(format_args!("open {url} in a browser"));
        if let (Some(shared), Some(viewer_url)) = (&self.shared, viewer_url) {
            print::report(format_args!("to let others watch without control, give them {viewer_url}"));
            if let [_, others @ ..] = &self.reachable_addresses()[..]
                && !others.is_empty()
            {
                let others: Vec<String> = others.iter().map(ToString::to_string).collect();
                print::report(format_args!("other addresses of this computer: {}", others.join(", ")));
            }
            let remark = if shared.is_self_signed { ", of which browsers warn once; compare this value" } else { "" };
            print::report(format_args!("SHA-256 fingerprint of the certificate{remark}: {}", shared.fingerprint));
            if std::io::stdout().is_terminal() {
                print::report(qr_code(&url)?);
            }
        }
        Ok(())
    }

    /// The addresses under which other machines may reach the page, the likeliest first; at least one.
    fn reachable_addresses(&self) -> Vec<IpAddr> {
        let listen = self.address().ip();
        if !listen.is_unspecified() {
            return vec![listen];
        }
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
        let default = default_route_address();
        addresses.sort_by_key(|address| (Some(*address) != default, address.is_ipv6()));
        if addresses.is_empty() {
            addresses.push(if listen.is_ipv4() { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() });
        }
        addresses
    }
}

/// This computer's address on the network with the default route, if there is one. No data is sent.
fn default_route_address() -> Option<IpAddr> {
    // An address for documentation (RFC 5737), which no network uses.
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).ok()?;
    socket.connect((Ipv4Addr::new(192, 0, 2, 1), 9)).ok()?;
    socket.local_addr().ok().map(|address| address.ip())
}

/// The token is in the fragment, which browsers send neither to servers nor to other sites.
fn shared_url(address: IpAddr, port: u16, token: &Token) -> String {
    format!("https://{}/#token={}", SocketAddr::new(address, port), token.text())
}

/// A QR code for terminals, dark on light whatever the terminal's colors.
fn qr_code(text: &str) -> anyhow::Result<String> {
    let code = QrCode::new(text).context("cannot create a QR code")?;
    let lines = code.render::<Dense1x2>().build();
    Ok(lines.lines().map(|line| format!("\x1b[30;107m{line}\x1b[0m")).collect::<Vec<_>>().join("\n"))
}
