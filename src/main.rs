//! The `fieldrig` command: parse, run, exit code.

mod allocator;
mod app_window;
mod checkpoint_args;
mod cli;
#[cfg(test)]
mod cli_page_tests;
mod commands;
mod console;
mod data_args;
mod exit;
mod flag_names;
#[cfg(test)]
mod flag_tests;
#[cfg(test)]
mod guide_tests;
mod named_args;
mod number_args;
mod open_gpu;
mod page_args;
mod permission_args;
mod print;
#[cfg(feature = "sim")]
mod scene_cache;
mod signals;
mod training_args;
mod user_folders;
mod version;
mod work_lines;

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    // This comes first, while the program has a single thread, because changing the environment is
    // unsafe with several threads.
    keep_wayland_quiet();
    messages::Setting::spell_as(flag_names::flag);
    let cli = cli::Cli::parse();
    print::start_log(cli.verbose);
    if cli.command.is_private() {
        // New folders get the mode 0700, and new files 0600.
        rustix::process::umask(rustix::fs::Mode::from_raw_mode(0o077));
    }
    #[cfg(feature = "sim")]
    scene_cache::start();
    let result = signals::fail_writes_at_size_limit()
        .and_then(|()| start_threads())
        .and_then(|()| cli.command.run());
    if let Err(error) = &result
        && !exit::is_broken_pipe(error)
    {
        print::error(error);
    }
    // The output is flushed, because the exit would end the writer threads with text in their
    // queues.
    print::flush();
    session::run_log::flush();
    match result {
        Ok(exit) => exit.or_output_loss().into(),
        Err(error) if exit::is_broken_pipe(&error) => exit::Exit::Done.into(),
        Err(error) => exit::of(&error).into(),
    }
}

fn start_threads() -> anyhow::Result<()> {
    background::start_threads().map_err(|error| {
        anyhow::anyhow!(
            "cannot start one thread per processor: {error}; raise the limits on threads (ulimit -u, TasksMax) and on memory"
        )
    })
}

/// Suppresses an irrelevant error on machines without a desktop. Software Vulkan connects to
/// Wayland, and libwayland prints an error if `XDG_RUNTIME_DIR` is not set. It prints no error if
/// `WAYLAND_DISPLAY` is an absolute path.
#[expect(
    unsafe_code,
    reason = "libwayland can only be configured through the environment"
)]
fn keep_wayland_quiet() {
    if std::env::var_os("XDG_RUNTIME_DIR").is_none()
        && std::env::var_os("WAYLAND_DISPLAY").is_none()
    {
        // SAFETY: this runs before anything else, so no other thread can read the environment.
        unsafe { std::env::set_var("WAYLAND_DISPLAY", "/nowhere") };
    }
}
