//! A run with a simulated arm in another process.

use anyhow::{Context, Result, bail};
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::process::{Child, Command, Stdio};

/// The run. Dropping it kills the process.
pub(super) struct RunProcess {
    child: Child,
    server: SocketAddr,
}

impl RunProcess {
    /// Starts a run that an operator may steer, and waits until it serves its page.
    ///
    /// # Errors
    ///
    /// If it does not start.
    pub(super) fn start(mut command: Command) -> Result<Self> {
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .context("cannot start the run")?;
        let stdout = child.stdout.take().context("the run has no output")?;
        let mut run = Self {
            child,
            server: SocketAddr::from(([127, 0, 0, 1], 0)),
        };
        let mut lines = BufReader::new(stdout).lines();
        let Some(line) = lines.next().transpose().context("the output of the run")? else {
            bail!("the run ended before it served its page");
        };
        let event: Value = serde_json::from_str(&line).context("the first event of the run")?;
        let url = event["url"].as_str().unwrap_or_default();
        let address = url.strip_prefix("http://").unwrap_or(url);
        run.server = address
            .trim_end_matches('/')
            .parse()
            .with_context(|| format!("the run serves its page at {url:?}"))?;
        // A run whose output nobody reads would wait.
        std::thread::Builder::new()
            .name("output of the run".to_owned())
            .spawn(move || lines.for_each(drop))
            .context("cannot start a thread")?;
        Ok(run)
    }

    /// Address of its server.
    pub(super) fn server(&self) -> SocketAddr {
        self.server
    }
}

impl Drop for RunProcess {
    fn drop(&mut self) {
        // Fails if the run has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
