//! A calibration target to print, as a PDF file.

use crate::symmetry::symmetry_warning;
use anyhow::Context;
use messages::{BadInput, Setting};
use std::path::PathBuf;
use targets::{Paper, TargetSpec};

/// A target, and the file to write.
#[derive(Clone, Debug)]
pub struct PrintedTargetTask {
    /// The target.
    pub target: TargetSpec,
    /// PDF file to write. It must not exist.
    pub out: PathBuf,
    /// Name or size of the paper, such as `a4` or `300x400mm`.
    pub paper: String,
}

impl PrintedTargetTask {
    /// Writes the file, and returns how to print and use the target.
    ///
    /// # Errors
    /// Fails if the target does not fit on the paper, or if the file exists or cannot be written.
    pub fn run(&self) -> anyhow::Result<String> {
        // All errors below are about the arguments, so nothing is written before they are checked.
        let bad = |error: targets::PrintError| BadInput(error.to_string());
        let paper: Paper = self.paper.parse().map_err(bad)?;
        let pdf = self.target.pdf(paper).map_err(bad)?;
        let out = self.out.display();
        if self
            .out
            .extension()
            .is_none_or(|extension| !extension.eq_ignore_ascii_case("pdf"))
        {
            return Err(BadInput(format!("{} {out}: must end with .pdf", Setting::Out)).into());
        }
        // An old file may describe a printed target that is still in use, so it is never replaced.
        if self.out.exists() {
            return Err(BadInput(format!("{out} exists")).into());
        }
        // This is only a warning, because the target can still be used to calibrate a lens.
        if let Some(warning) = symmetry_warning(&self.target) {
            log::warn!("{warning}");
        }
        files::write(&self.out, pdf).with_context(|| format!("cannot write {out}"))?;
        Ok(format!(
            "{out}: print it at 100 % (no scaling), measure the ruler, and fix it to something flat.\nCalibrate with \
             {} {}",
            Setting::Target,
            self.target
        ))
    }
}
