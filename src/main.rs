//! The `fieldrig` command: parse, run, exit code.

mod allocator;
mod bench;
mod camera_list;
mod camera_path;
mod chart;
mod checkpoints;
mod cli;
mod clock;
mod commands;
mod config;
mod corrected_rig;
mod data;
mod dataset;
mod decisions;
mod depth_from;
mod downscale;
mod evaluate;
mod evaluation_schedule;
mod exit;
mod export;
mod feed;
mod fingerprint;
mod holdout;
mod join;
mod live;
mod method;
mod next_commands;
mod open;
mod open_gpu;
mod partial;
mod pending_evaluation;
mod print;
mod recoveries;
mod recovery;
mod render_budget;
mod replay;
mod report;
mod run_folder;
mod scene_hint;
mod session;
mod stations;
mod stop;
mod stored_keyframes;
#[cfg(test)]
#[path = "../tests/common/test_data.rs"]
mod test_data;
mod time_slices;
mod training;
mod training_args;
mod viewer;

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    keep_wayland_quiet();
    let cli = cli::Cli::parse();
    print::start_log(cli.verbose);
    let ended = cli.command.run();
    if let Err(error) = &ended
        && !exit::is_broken_pipe(error)
    {
        print::error(error);
    }
    print::flush();
    match ended {
        Ok(exit) => exit.or_output_loss().into(),
        Err(error) if exit::is_broken_pipe(&error) => exit::Exit::Done.into(),
        Err(error) => exit::of(&error).into(),
    }
}

/// Keeps software Vulkan from printing an irrelevant error on machines without a desktop: it looks for a Wayland
/// display there, and its library complains if there is none, unless the display is given as an absolute path.
#[expect(unsafe_code, reason = "that library can only be configured through the environment")]
fn keep_wayland_quiet() {
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() && std::env::var_os("WAYLAND_DISPLAY").is_none() {
        // SAFETY: this runs before anything else, so no other thread can read the environment.
        unsafe { std::env::set_var("WAYLAND_DISPLAY", "/nowhere") };
    }
}
