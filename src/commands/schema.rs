//! `fieldrig schema`: prints the JSON schema of rig files.

use crate::print;
use anyhow::Context;
use capture::Rig;
use trainer::ModelKind;

/// Flags of `schema`.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
    Editors use the schema to complete keys, to show their descriptions, and to mark mistakes. For example, editors with \
    the extension Even Better TOML (taplo) use it for a rig file that begins with `#:schema PATH/rig.schema.json`.\n\n\
    The schema accepts every valid rig file. Some rules need several keys or other files, such as the number of joint \
    offsets. They are only checked when a rig file is read: `fieldrig doctor RIG.toml`.")]
pub(crate) struct Args {}

/// Prints the schema.
pub(crate) fn run(_args: &Args) -> anyhow::Result<()> {
    let methods: Vec<&str> = ModelKind::ALL.iter().map(|kind| kind.name()).collect();
    let schema = Rig::json_schema(&methods);
    let text = serde_json::to_string_pretty(&schema).context("cannot write the schema")?;
    Ok(print::line(text)?)
}
