//! Flags for the address of the page, and who may open it.

use crate::app_window::AppWindow;
use crate::{print, user_folders};
use anyhow::Context;
use messages::{BadInput, quoted_for_shell};
use qrcode::QrCode;
use qrcode::render::unicode::Dense1x2;
use serde_json::Value;
use std::io::IsTerminal;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use viz::{CertificateSource, Hub, PageOptions, ServedPage, Workspace};

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
    /// Also open the page in a window of an installed Chromium-based browser, without address bar
    /// and tabs. Closing the window does not end the command
    #[arg(long)]
    app: bool,
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
        self.listen.is_some() || self.share || self.foxglove.is_some() || self.app
    }

    /// Rejects an address that other machines can reach, unless the page is shared, flags that this
    /// build lacks, and a window that cannot be opened.
    pub(crate) fn check(&self) -> Result<(), BadInput> {
        if let Some(address) = self.listen
            && !address.ip().is_loopback()
            && !self.share
        {
            // The user can copy the command with the missing flag.
            let command: Vec<String> = std::env::args()
                .skip(1)
                .map(|word| quoted_for_shell(&word))
                .collect();
            return Err(BadInput(format!(
                "other machines can reach {address}, so the page must be encrypted and require a token: run \
                 `fieldrig {} --share`",
                command.join(" ")
            )));
        }
        let options = self.options()?;
        options
            .check()
            .map_err(|error| BadInput(error.to_string()))?;
        self.window().map(|_| ())
    }

    /// The window to open, if one is wanted.
    fn window(&self) -> Result<Option<AppWindow>, BadInput> {
        self.app
            .then(|| AppWindow::find(&data_folder()?))
            .transpose()
    }

    /// Prints the addresses of a page, and opens its window if one is wanted. If `is_json` is set,
    /// prints them as an event that also has these fields.
    pub(crate) fn announce(
        &self,
        page: &ServedPage,
        is_json: bool,
        fields: Value,
    ) -> anyhow::Result<()> {
        print_page(page, is_json, fields)?;
        self.open_window(page)
    }

    /// Opens the window of a page if one is wanted.
    pub(crate) fn open_window(&self, page: &ServedPage) -> anyhow::Result<()> {
        match self.window()? {
            Some(window) => window.open(&page.url()),
            None => Ok(()),
        }
    }

    /// Serves the page.
    pub(crate) fn serve(&self, hub: &Hub) -> anyhow::Result<ServedPage> {
        Ok(self.options()?.serve(hub)?)
    }

    /// Serves the page; if the default address is in use, at a free port.
    pub(crate) fn serve_or_free_port(&self, hub: &Hub) -> anyhow::Result<ServedPage> {
        Ok(self.options()?.serve_or_free_port(hub)?)
    }

    /// The flags as options.
    fn options(&self) -> Result<PageOptions, BadInput> {
        let shared_with = match &self.certificate {
            _ if !self.share => None,
            Some(file) => Some(CertificateSource::Files {
                certificate: file.clone(),
                key: self.certificate_key.as_ref().unwrap_or(file).clone(),
            }),
            None => Some(CertificateSource::KeptIn(data_folder()?)),
        };
        Ok(PageOptions {
            listen: self.listen,
            shared_with,
            foxglove: self.foxglove,
        })
    }
}

/// Reads the workspace with which the page starts, if there is one.
pub(crate) fn workspace_at(path: Option<&Path>) -> Result<Option<Workspace>, BadInput> {
    path.map(Workspace::read)
        .transpose()
        .map_err(|error| BadInput(error.to_string()))
}

/// Prints the addresses of a page. If `is_json` is set, prints them as an event that also has these
/// fields.
fn print_page(page: &ServedPage, is_json: bool, fields: Value) -> anyhow::Result<()> {
    if is_json {
        let mut event = page.event();
        if let (Value::Object(event), Value::Object(fields)) = (&mut event, fields) {
            event.extend(fields);
        }
        return print::report_json(&event);
    }
    page.lines().iter().for_each(print::report);
    // The QR code is for phones, which cannot reach a page that only this computer can open.
    if page.is_shared() && std::io::stdout().is_terminal() {
        print::report_styled(qr_code(&page.url())?);
    }
    Ok(())
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

/// The user's folder for data of this program.
fn data_folder() -> Result<PathBuf, BadInput> {
    user_folders::data().ok_or_else(|| {
        BadInput(
            "there is no home folder for the TLS certificate and the profile of the window: set HOME"
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
