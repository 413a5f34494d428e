//! Flags for the address of the page, and who may open it.

use crate::served_page::{ServedPage, Shared};
use anyhow::Context;
use messages::BadInput;
use session::next_commands::quoted;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use viz::{Certificate, Hub, Server, ServerConfig, Sharing, Tokens};

/// Where the page is served, and to whom.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct PageArgs {
    /// Address of the page: numeric IP address or localhost, and port [default: 127.0.0.1:7007, with --share
    /// 0.0.0.0:7007; `view`, `preview` and `calibrate` take a free port if this port is in use]
    #[arg(long, value_name = "ADDRESS", value_parser = address)]
    listen: Option<SocketAddr>,
    /// Serve the page to other machines over TLS. The printed addresses contain the required token
    #[arg(long)]
    share: bool,
    /// TLS certificate for --share, with its chain (PEM) [default: self-signed, kept for later
    /// runs]
    #[arg(long, value_name = "FILE", requires = "share")]
    certificate: Option<PathBuf>,
    /// Private key of --certificate (PEM) [default: the file of --certificate]
    #[arg(long, value_name = "FILE", requires = "certificate")]
    certificate_key: Option<PathBuf>,
    /// Also serve images, joint states, frames, keyframes and metrics to Foxglove at this loopback
    /// address
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, require_equals = true,
        default_missing_value = "127.0.0.1:8765", value_parser = address)]
    foxglove: Option<SocketAddr>,
}

/// Parses the address of the page. Other names than localhost are not resolved, because a name may
/// have several addresses.
fn address(text: &str) -> Result<SocketAddr, String> {
    let on_this_computer = text
        .strip_prefix("localhost:")
        .and_then(|port| port.parse().ok())
        .map(|port| SocketAddr::new(Ipv4Addr::LOCALHOST.into(), port));
    match on_this_computer {
        Some(address) => Ok(address),
        None => text.parse().map_err(|_| {
            "expected an IP address or localhost, and a port, such as 127.0.0.1:7007".to_owned()
        }),
    }
}

impl PageArgs {
    /// Whether any of the flags is given.
    pub(crate) fn is_given(&self) -> bool {
        self.listen.is_some() || self.share || self.foxglove.is_some()
    }

    /// Rejects an address that other machines can reach, unless the page is shared, and flags that
    /// this build lacks.
    pub(crate) fn check(&self) -> Result<(), BadInput> {
        match self.listen {
            Some(address) if !address.ip().is_loopback() && !self.share => {
                // The user can copy the command with the missing flag.
                let command: Vec<String> = std::env::args().skip(1).map(|word| quoted(&word)).collect();
                Err(BadInput(format!(
                    "other machines can reach {address}, so the page must be encrypted and require a token: run \
                     `fieldrig {} --share`",
                    command.join(" ")
                )))
            }
            _ if self.foxglove.is_some() && !cfg!(feature = "foxglove") => Err(BadInput(
                "--foxglove: this program was built without Foxglove support: build with `--features foxglove`"
                    .to_owned(),
            )),
            _ => Ok(()),
        }
    }

    /// Serves the page.
    pub(crate) fn serve(&self, hub: &Hub) -> anyhow::Result<ServedPage> {
        self.serve_at(self.listen.unwrap_or_else(|| self.default_address()), hub)
    }

    /// Serves the page; if the default address is in use, at a free port.
    pub(crate) fn serve_or_free_port(&self, hub: &Hub) -> anyhow::Result<ServedPage> {
        // A user who gives an address expects the page there. The default address is only a
        // proposal.
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
        // The default address can only be reached from this computer.
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
        Ok(ServedPage {
            server,
            shared,
            #[cfg(feature = "foxglove")]
            foxglove: self
                .foxglove
                .map(|address| viz::FoxgloveServer::start(address, hub.clone()))
                .transpose()?,
        })
    }

    fn share_at(&self, config: ServerConfig, hub: &Hub) -> anyhow::Result<(Server, Shared)> {
        let certificate = match &self.certificate {
            Some(file) => Certificate::read(file, self.certificate_key.as_ref().unwrap_or(file))?,
            // The certificate is kept, so that browsers which have accepted it do not warn at the
            // next run.
            None => Certificate::kept_in(&data_folder()?)?,
        };
        let tokens = Tokens::random().context("cannot create a token")?;
        let fingerprint = certificate.fingerprint();
        let is_self_signed = self.certificate.is_none();
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
}

/// The user's folder for data of this program.
fn data_folder() -> Result<PathBuf, BadInput> {
    let given = std::env::var_os("XDG_DATA_HOME")
        .map(PathBuf::from)
        // The XDG specification says to ignore relative paths.
        .filter(|folder| folder.is_absolute());
    let in_home = || Some(std::env::home_dir()?.join(".local/share"));
    given
        .or_else(in_home)
        .map(|folder| folder.join("fieldrig"))
        .ok_or_else(|| {
            BadInput(
                "there is no home folder for the TLS certificate: set HOME, or use --certificate"
                    .to_owned(),
            )
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_numeric_or_localhost() {
        for (text, expected) in [
            ("127.0.0.1:7007", "127.0.0.1:7007"),
            ("[::1]:7007", "[::1]:7007"),
            ("localhost:7007", "127.0.0.1:7007"),
            ("localhost:0", "127.0.0.1:0"),
        ] {
            let found = address(text).expect(text);
            assert_eq!(found.to_string(), expected);
        }
        for text in [
            "localhost",
            "localhost:",
            "localhost:99999",
            "robot:7007",
            "7007",
        ] {
            let error = address(text).expect_err(text);
            assert!(error.contains("127.0.0.1:7007"), "{error}");
        }
    }
}
