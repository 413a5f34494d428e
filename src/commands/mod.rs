//! The subcommands, one file each.

pub(crate) mod bench;
pub(crate) mod devices;
pub(crate) mod doctor;
pub(crate) mod eval;
pub(crate) mod export;
pub(crate) mod fk;
pub(crate) mod metrics;
pub(crate) mod move_arm;
pub(crate) mod record;
pub(crate) mod render;
pub(crate) mod run;
pub(crate) mod sim;
pub(crate) mod train;
pub(crate) mod view;

use crate::allocator;
use crate::cli::Command;
use crate::exit::{BadArgument, Exit};
use crate::recovery;
use std::ops::RangeInclusive;
use std::sync::Arc;
use trainer::gpu::{Gpu, GpuOptions};

/// Returns a parser for a numeric flag that accepts values in the given range.
fn number_in_range(range: RangeInclusive<f64>) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync {
    move |text| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| format!("must be {} to {}", range.start(), range.end()))
    }
}

/// Runs a command.
pub(crate) fn run(command: Command) -> anyhow::Result<Exit> {
    match command {
        Command::Run(args) => run::run(&args),
        Command::Record(args) => record::run(&args),
        Command::Train(args) => train::run(&args),
        Command::View(args) => view::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Metrics(args) => metrics::run(args).map(|()| Exit::Done),
        Command::Export(args) => export::run(&args),
        Command::Fk(args) => fk::run(args).map(|()| Exit::Done),
        Command::Bench(args) => bench::run(&args),
        Command::Devices(args) => devices::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Sim(args) => sim::run(&args),
        Command::Move(args) => move_arm::run(&args),
    }
}

/// Opens the GPU. `FIELDRIG_GPU` selects one of several; `FIELDRIG_GPU_FEATURES=none` disables all optional features,
/// and `no-matrices` only cooperative matrices.
pub(crate) fn open_gpu() -> anyhow::Result<Arc<Gpu>> {
    open_gpu_with(GpuOptions::default())
}

fn open_gpu_with(options: GpuOptions) -> anyhow::Result<Arc<Gpu>> {
    let features = std::env::var_os("FIELDRIG_GPU_FEATURES");
    let [optional_features, matrices] =
        ["none", "no-matrices"].map(|word| features.as_ref().is_none_or(|value| value != word));
    let adapter = match std::env::var("FIELDRIG_GPU") {
        Ok(text) => {
            let invalid = |_| BadArgument(format!("FIELDRIG_GPU: {text:?} is not the number of a GPU"));
            Some(text.parse().map_err(invalid)?)
        }
        Err(_) => None,
    };
    recovery::hide_caught_panics();
    recovery::check_open_for_tests()?;
    // Lets tests exhaust GPU memory.
    let memory_limit_bytes = std::env::var("FIELDRIG_TEST_GPU_BYTES").ok().and_then(|text| text.parse().ok());
    let gpu = Gpu::open(&GpuOptions { optional_features, matrices, memory_limit_bytes, adapter, ..options })?;
    if gpu.is_software() {
        allocator::keep_images_out_of_heaps();
    }
    Ok(gpu)
}
