//! `fieldrig view`: serves saved models on the web page.

use crate::exit::Exit;
use crate::open_gpu::open_gpu;
use crate::page_args::{PageArgs, workspace_at};
use crate::signals;
use nalgebra::Vector3;
use serde_json::json;
use session::{ModelViewer, check_is_model, load_saved, model_from_page, run_folder};
use std::path::PathBuf;
use viz::Hub;

/// Flags of `view`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder of a saved model or of a run with several methods, or a splat file (.ply, .spz,
    /// .splat)
    model: PathBuf,
    #[command(flatten)]
    page: PageArgs,
    /// Axis of the model that points up: x, y, z, -x, -y or -z; files from other programs are often
    /// -y up
    #[arg(long, value_name = "AXIS", default_value = "z", allow_hyphen_values = true, value_parser = up_axis)]
    up: Up,
    /// Start the page with this workspace, which the page has saved: camera, layers, crop box,
    /// panels and model
    #[arg(long, value_name = "FILE")]
    workspace: Option<PathBuf>,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

/// Direction that points up in the model's world.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Up(Vector3<f64>);

fn up_axis(text: &str) -> Result<Up, String> {
    let (sign, axis) = text
        .strip_prefix('-')
        .map_or((1.0, text), |axis| (-1.0, axis));
    let axis = match axis {
        "x" => Vector3::x(),
        "y" => Vector3::y(),
        "z" => Vector3::z(),
        _ => return Err("expected x, y, z, -x, -y or -z".to_owned()),
    };
    Ok(Up(sign * axis))
}

/// Serves the page until Ctrl-C.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    args.page.check()?;
    let workspace = workspace_at(args.workspace.as_deref())?;
    check_is_model(&args.model)?;
    let paths = run_folder::models_at(&args.model)?;
    let stop = signals::stop_on_signals_logging("stopping; Ctrl-C again exits at once")?;
    let gpu = open_gpu()?;
    let hub = Hub::new();
    if let Some(workspace) = workspace {
        hub.set_workspace(workspace);
    }
    // The server starts before the models are loaded, so that an address in use is reported at
    // once.
    let page = args.page.serve_or_free_port(&hub)?;

    let model_from_page = model_from_page(&args.up.0);
    let models = load_saved(&hub, &gpu, paths, &model_from_page)?;
    let methods: Vec<&str> = models.iter().map(|model| model.kind.name()).collect();
    args.page
        .announce(&page, args.json, json!({ "methods": methods }))?;
    ModelViewer::new(models, hub)
        .with_model_from_page(model_from_page)
        .serve(&stop);
    Ok(Exit::Done)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_parsed() {
        assert_eq!(up_axis("-y"), Ok(Up(-Vector3::y())));
        for invalid in ["", "up", "--z", "Z", "xy"] {
            assert!(up_axis(invalid).is_err(), "{invalid}");
        }
    }
}
