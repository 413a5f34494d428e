//! The new rig file.

use super::plan::RigPlan;
use super::wishes::{RobotChoice, Wishes};
use crate::config::Rig;
use anyhow::Context;
use messages::{BadInput, Setting};
use std::path::PathBuf;

/// Where a new rig file is written.
#[derive(Clone, Debug)]
pub struct NewRigFile {
    /// Path of the file.
    pub path: PathBuf,
    /// Whether an existing file is replaced.
    pub can_replace: bool,
}

impl NewRigFile {
    /// Checks that the file can be written.
    ///
    /// # Errors
    /// If it exists and must not be replaced, or if its folder does not accept files.
    pub fn check(&self) -> Result<(), BadInput> {
        self.check_new()?;
        files::destination::check_file(&self.path)
            .map_err(|problem| BadInput(format!("cannot write {}: {problem}", self.path.display())))
    }

    /// Writes the rig file, after it was read like any other rig file.
    ///
    /// # Errors
    /// If the rig file would be invalid, exists, or cannot be written.
    pub fn write(&self, wishes: &Wishes, plan: &RigPlan) -> anyhow::Result<()> {
        let path = self.path.display();
        let text = plan.to_toml(&path.to_string());
        let urdf = match &wishes.robot {
            RobotChoice::Urdf { text, .. } => text,
            _ => "",
        };
        Rig::parse(&path.to_string(), &text, urdf, &[])
            .context("the rig file would be invalid, so it was not written")?;
        // Another program may have written it during the search.
        self.check_new()?;
        files::write(&self.path, text).with_context(|| format!("cannot write {path}"))
    }

    fn check_new(&self) -> Result<(), BadInput> {
        if !self.can_replace && self.path.symlink_metadata().is_ok() {
            let rig = self.path.display();
            return Err(BadInput(format!(
                "{rig} exists: choose another name, or replace it with {}",
                Setting::Force
            )));
        }
        Ok(())
    }
}
