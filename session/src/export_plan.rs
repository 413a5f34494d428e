//! Export of a model or a recording to the format of another program.

use crate::dataset_export::RecordingExport;
use crate::recoveries::OpenGpu;
use crate::{methods, run_folder};
use anyhow::{Context, ensure};
use messages::{BadInput, Setting, counted, listed};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use trainer::ModelKind;
use trainer::method_entry::{Export, ExportRequest, ExportWriter, Exported};

/// The output format for recordings: a folder.
pub const NERFSTUDIO: &str = "nerfstudio";

/// The output formats of all methods and of recordings, each with a description.
#[must_use]
pub fn export_formats() -> Vec<(&'static str, String)> {
    let mut contents: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for export in ModelKind::ALL.iter().flat_map(|kind| kind.entry().exports) {
        let contents = contents.entry(export.format).or_default();
        contents.push(export.contents);
    }
    let mut formats: Vec<_> = contents
        .into_iter()
        .map(|(format, contents)| {
            let contents = listed(&contents, "or");
            (
                format,
                format!("From a model: its {contents}, as .{format}"),
            )
        })
        .collect();
    formats.push((
        NERFSTUDIO,
        "From a recording: a folder with PNG photos, 16-bit depth, and transforms.json with poses and split lists"
            .to_owned(),
    ));
    formats
}

/// Options of an export.
#[derive(Clone, Debug)]
pub struct ExportPlan {
    /// A model folder, a splat file, or a recording.
    pub from: PathBuf,
    /// Output format.
    pub format: String,
    /// File or folder to write. It must not exist.
    pub out: PathBuf,
    /// Width of the cells in which the mesh of a distance field gets one vertex, meters.
    pub cell_m: Option<f64>,
    /// List of the keyframes to export. `None` exports the keyframes that a run would accept.
    pub keyframes: Option<PathBuf>,
    /// Rig file that replaces the one stored in the recording.
    pub rig: Option<PathBuf>,
}

/// An export whose input and output were checked.
pub enum CheckedExport<'a> {
    /// A model to export.
    Model(ModelExport<'a>),
    /// A recording to export.
    Recording(RecordingExport),
}

/// A model to export.
pub struct ModelExport<'a> {
    export: &'static Export,
    plan: &'a ExportPlan,
}

/// Content of the input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Contents {
    Model(ModelKind),
    Recording,
}

impl ExportPlan {
    /// Checks the input and the output, before a model is loaded, because loading may take long.
    ///
    /// # Errors
    /// Fails if the input cannot be exported to the format, if the output exists or cannot be
    /// written, or if a setting has no effect.
    pub fn check(&self) -> anyhow::Result<CheckedExport<'_>> {
        let contents = contents(&self.from)?;
        let has_cells =
            |kind: ModelKind| kind.entry().exports.iter().any(|export| export.has_cells);
        // A setting without an effect is probably a mistake of the user, so it is an error.
        if self.cell_m.is_some() && !matches!(contents, Contents::Model(kind) if has_cells(kind)) {
            let from = self.from.display();
            return Err(BadInput(format!("{}: {from} has no mesh", Setting::CellM)).into());
        }
        self.check_out()?;
        match (contents, &*self.format) {
            (Contents::Recording, NERFSTUDIO) => Ok(CheckedExport::Recording(RecordingExport {
                recording: self.from.clone(),
                rig: self.rig.clone(),
                keyframes: self.keyframes.clone(),
                out: self.out.clone(),
            })),
            (Contents::Recording, _) => Err(self
                .unsupported("this is a recording; splats and meshes are exported from a model")),
            (Contents::Model(_), NERFSTUDIO) => {
                Err(self.unsupported("this is a model; nerfstudio is exported from a recording"))
            }
            (Contents::Model(kind), format) => match kind
                .entry()
                .exports
                .iter()
                .find(|export| export.format == format)
            {
                Some(export) => Ok(CheckedExport::Model(ModelExport { export, plan: self })),
                None => Err(self.unsupported(&describe_exports(kind, format))),
            },
        }
    }

    /// Rejects an output file that exists or has the wrong extension.
    fn check_out(&self) -> Result<(), BadInput> {
        let extension = &self.format;
        // This output is a folder.
        if extension == NERFSTUDIO {
            return capture::check_output_folder(Setting::Out, &self.out);
        }
        let out = self.out.display();
        if !self
            .out
            .extension()
            .is_some_and(|actual| actual.eq_ignore_ascii_case(extension))
        {
            return Err(BadInput(format!(
                "{} {out}: the file name must end in .{extension}",
                Setting::Out
            )));
        }
        if self.out.exists() {
            return Err(BadInput(format!(
                "{} {out}: the file exists; choose another name",
                Setting::Out
            )));
        }
        capture::check_output_file(Setting::Out, &self.out)
    }

    fn unsupported(&self, sentence: &str) -> anyhow::Error {
        BadInput(format!("{}: {sentence}", self.from.display())).into()
    }
}

impl ModelExport<'_> {
    /// Writes the model, and returns a description of the files.
    ///
    /// # Errors
    /// Fails if the model cannot be read, or the file cannot be written.
    pub fn run(&self, open_gpu: OpenGpu) -> anyhow::Result<String> {
        let out = &self.plan.out;
        let exported = files::create_from(out, |inside| self.write(open_gpu, inside));
        let Exported {
            n_items,
            item,
            detail,
        } = exported.with_context(|| format!("cannot write {}", out.display()))?;
        let separator = if detail.is_empty() { "" } else { " " };
        Ok(format!("{}{separator}{detail}", counted(n_items, item)))
    }

    /// Writes the model to the file `out`, which is renamed when it is complete.
    fn write(&self, open_gpu: OpenGpu, out: &Path) -> anyhow::Result<Exported> {
        let request = ExportRequest {
            model: &self.plan.from,
            out,
            cell_m: self.plan.cell_m,
        };
        let exported = match self.export.write {
            ExportWriter::Cpu(write) => write(&request),
            ExportWriter::Gpu(write) => write(open_gpu()?, &request),
        };
        exported.map_err(|error| match error {
            // The cell width is an argument, so the user can try another width.
            trainer::Error::EmptyMesh { cell_m } => anyhow::Error::new(BadInput(format!(
                "{} {cell_m}: no triangles are left at this cell width; use a smaller one",
                Setting::CellM
            ))),
            error => error.into(),
        })
    }
}

/// Why a model cannot be exported to a format.
fn describe_exports(kind: ModelKind, format: &str) -> String {
    let formats: Vec<&str> = kind
        .entry()
        .exports
        .iter()
        .map(|export| export.format)
        .collect();
    let model = kind.entry().model;
    if formats.is_empty() {
        return format!("{model} cannot be exported");
    }
    format!(
        "{model} cannot be exported as {format}, only as {}",
        listed(&formats, "or")
    )
}

fn contents(path: &Path) -> anyhow::Result<Contents> {
    ensure!(
        path.exists(),
        BadInput(format!("{} does not exist", path.display()))
    );
    if let Some(kind) = methods::kind_of(path)? {
        run_folder::expect_model(path)?;
        return Ok(Contents::Model(kind));
    }
    let sentence = "not a model folder, a splat file or a recording";
    ensure!(
        path.is_file(),
        BadInput(format!("{}: {sentence}", path.display()))
    );
    Ok(Contents::Recording)
}
