//! Flags that select images.

use capture::downscale;
use session::DataOptions;
use std::path::PathBuf;

/// Which images are used, and for what.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct DataArgs {
    /// Use every N-th image for testing, or the images listed in a file, one per line. With 1,
    /// `eval` scores all images [default: 8]
    #[arg(long, value_name = "N|FILE")]
    holdout: Option<String>,
    /// Use exactly the keyframes listed by an earlier run (keyframes.txt)
    #[arg(long, value_name = "FILE", conflicts_with = "holdout")]
    keyframes: Option<PathBuf>,
    /// Read a recording with this rig file instead of the rig file stored in the recording
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// Scale the images (not their depth) to this fraction of their width and height, 0.05 to 1
    /// [default: value of the rig file, else 1]
    #[arg(long, value_name = "FRACTION", value_parser = downscale::parse_scale)]
    scale: Option<f64>,
}

impl DataArgs {
    /// The flags as options.
    pub(crate) fn options(&self) -> DataOptions {
        let Self {
            holdout,
            keyframes,
            rig,
            scale,
        } = self.clone();
        DataOptions {
            holdout,
            keyframes,
            rig,
            scale,
        }
    }
}
