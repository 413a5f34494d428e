//! Flags of `run` for benches that measure a run.

use crate::commands::run;
use clap::Parser;
use messages::BadInput;
use std::ffi::OsString;
use std::path::Path;

/// The flags of `run`, which are parsed as a command line.
#[derive(Debug, Parser)]
struct RunFlags {
    #[command(flatten)]
    args: run::Args,
}

/// Parses the flags of a run that writes to `out` and serves its page on a free port of this
/// computer.
///
/// * `given`: the flags that the user gave for the run.
pub(super) fn parse(
    rig_file: &Path,
    seconds: f64,
    (out, json): (&Path, bool),
    flags: Vec<OsString>,
    given: &[OsString],
) -> Result<run::Args, BadInput> {
    let mut line: Vec<OsString> = vec!["run".into(), rig_file.into()];
    line.extend(flags);
    line.extend(["--seconds".into(), seconds.to_string().into()]);
    // Port 0 means any free port, so that a bench does not collide with a run that serves its page.
    line.extend([
        "--out".into(),
        out.into(),
        "--listen".into(),
        "127.0.0.1:0".into(),
    ]);
    if json {
        line.push("--json".into());
    }
    line.extend(given.iter().cloned());
    let parsed = RunFlags::try_parse_from(line).map_err(|error| {
        let message = error.to_string();
        // The rest of the message is the usage of this parser. It is left out, because the user did
        // not call this parser.
        let first = message.lines().next().unwrap_or_default();
        BadInput(format!(
            "flags of run: {}",
            first.strip_prefix("error: ").unwrap_or(first)
        ))
    })?;
    Ok(parsed.args)
}
