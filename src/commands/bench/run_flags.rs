//! Runs that a bench measures, with flags of `run` that the user adds.

use crate::commands::run::{self, Running};
use bench::{MeasuredRun, RequestedRun};
use clap::Parser;
use messages::BadInput;
use session::RunInput;
use std::ffi::OsString;

/// The flags of `run`, which are parsed as a command line.
#[derive(Debug, Parser)]
struct RunFlags {
    #[command(flatten)]
    args: run::Args,
}

/// Starts a run, and serves its page on a free port of this computer.
///
/// * `given`: the flags that the user gave for the run.
pub(super) fn start(
    requested: &RequestedRun,
    json: bool,
    given: &[OsString],
) -> anyhow::Result<MeasuredRun> {
    let Running { run, page, .. } = run::start(&parse(requested, json, given)?, None)?;
    Ok(MeasuredRun { run, page })
}

fn parse(requested: &RequestedRun, json: bool, given: &[OsString]) -> Result<run::Args, BadInput> {
    let mut line: Vec<OsString> = vec!["run".into(), requested.rig_file.clone().into()];
    let mut add = |flag: &str, is_given: bool| line.extend(is_given.then(|| flag.into()));
    match &requested.input {
        RunInput::Devices {
            is_simulated,
            is_lockstep,
        } => {
            add("--sim", *is_simulated);
            add("--lockstep", *is_lockstep);
        }
        RunInput::Recording {
            path,
            is_real_time,
            is_repeated,
        } => {
            add("--real-time", *is_real_time);
            add("--repeat", *is_repeated);
            line.extend(["--from".into(), path.into()]);
        }
    }
    line.extend(["--seconds".into(), requested.seconds.to_string().into()]);
    line.extend(["--out".into(), requested.out.clone().into()]);
    // Port 0 means any free port, so that a bench does not collide with a run that serves its page.
    line.extend(["--listen".into(), "127.0.0.1:0".into()]);
    line.extend(json.then(|| "--json".into()));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_of_the_user_are_added_and_invalid_ones_named() {
        let requested = RequestedRun {
            rig_file: "rig.toml".into(),
            input: RunInput::Devices {
                is_simulated: true,
                is_lockstep: false,
            },
            seconds: 900.0,
            out: "some".into(),
        };
        let parsed = |flags: [&str; 2]| parse(&requested, false, &flags.map(OsString::from));
        assert!(parsed(["--method", "tsdf"]).is_ok());
        let message = parsed(["--metod", "tsdf"]).expect_err("no such flag");
        assert!(message.to_string().contains("--metod"), "{message}");
        let of_recording = RequestedRun {
            input: RunInput::Recording {
                path: "scan.mcap".into(),
                is_real_time: true,
                is_repeated: true,
            },
            ..requested.clone()
        };
        assert!(parse(&of_recording, true, &[]).is_ok());
    }
}
