//! The files of saved models that clients of the page can download: exports and reports.
//!
//! They are opened or made when a client requests them, on a thread of the server, so that pictures
//! do not wait. Exports that need the GPU are only offered if the folder of the model contains them.

use crate::report;
use model_files::Edits;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::ModelKind;
use trainer::method_entry::{Export, ExportRequest, ExportWriter};
use viz::ServedFile;

/// The files of models that were saved together.
///
/// * `models`: the kind of each model, with its folder or file.
pub(crate) fn of_models<'a>(
    models: impl Iterator<Item = (ModelKind, &'a PathBuf)> + Clone,
) -> Vec<ServedFile> {
    let is_single = models.clone().nth(1).is_none();
    models
        .flat_map(|(kind, model)| of_model(kind, model, is_single))
        .collect()
}

fn of_model(kind: ModelKind, model: &Path, is_single: bool) -> Vec<ServedFile> {
    let mut served: Vec<ServedFile> = kind
        .entry()
        .exports
        .iter()
        .filter(|export| is_available(export, kind, model))
        .map(|export| export_file(export, kind, model))
        .collect();
    let page = model.join(report::FILE);
    if page.is_file() {
        let of = if is_single {
            String::new()
        } else {
            format!(" of {}", kind.name())
        };
        served.push(ServedFile {
            name: format!("{}-{}", kind.name(), report::FILE),
            label: format!("Report{of}"),
            save_as: None,
            open: Arc::new(move || open(&page)),
        });
    }
    served
}

fn export_file(export: &'static Export, kind: ModelKind, model: &Path) -> ServedFile {
    let Export {
        format, contents, ..
    } = export;
    let path = model.to_owned();
    ServedFile {
        name: format!("{}.{format}", kind.name()),
        label: format!("{} ({})", capitalized(contents), format.to_uppercase()),
        save_as: Some(format!("{}.{format}", base_name(kind, model))),
        open: Arc::new(move || open_export(export, kind, &path)),
    }
}

/// Whether an export can be made without the GPU, which draws pictures.
fn is_available(export: &Export, kind: ModelKind, model: &Path) -> bool {
    matches!(export.write, ExportWriter::Cpu(_)) || saved_file(export, kind, model).is_some()
}

/// The file of a saved model that has the format of an export; `None` if it has none.
fn saved_file(export: &Export, kind: ModelKind, model: &Path) -> Option<PathBuf> {
    let has_format = |path: &Path| {
        path.extension()
            .is_some_and(|extension| extension.eq_ignore_ascii_case(export.format))
    };
    let candidates: Vec<PathBuf> = if model.is_dir() {
        kind.entry()
            .files
            .iter()
            .map(|file| model.join(file))
            .collect()
    } else {
        vec![model.to_owned()]
    };
    candidates
        .into_iter()
        .find(|path| has_format(path) && path.is_file())
}

/// Opens an export. Erased space is left out, as far as the edits are saved.
fn open_export(export: &Export, kind: ModelKind, model: &Path) -> Result<File, String> {
    let saved = saved_file(export, kind, model);
    match export.write {
        // The mesh of a distance field is saved without erased space.
        ExportWriter::Gpu(_) => {
            let saved = saved
                .ok_or_else(|| format!("{} has no .{} any more", model.display(), export.format))?;
            open(&saved)
        }
        ExportWriter::Cpu(write) => {
            let edits = Edits::read(model).map_err(|error| error.to_string())?;
            match saved.filter(|_| edits.is_empty()) {
                Some(saved) => open(&saved),
                None => convert(model, export.format, write),
            }
        }
    }
}

/// Converts a model to a temporary file, and opens it.
fn convert(
    model: &Path,
    format: &str,
    write: fn(&ExportRequest<'_>) -> Result<trainer::method_entry::Exported, trainer::Error>,
) -> Result<File, String> {
    let folder = tempfile::tempdir()
        .map_err(|error| format!("cannot create a temporary folder: {error}"))?;
    let out = folder.path().join(format!("model.{format}"));
    let request = ExportRequest {
        model,
        out: &out,
        cell_m: None,
    };
    write(&request).map_err(|error| format!("{:#}", anyhow::Error::from(error)))?;
    // The folder is removed at the end of this function. The file can still be read, because the
    // system keeps the content of an open file.
    open(&out)
}

fn open(path: &Path) -> Result<File, String> {
    files::open(path).map_err(|error| format!("cannot read {}: {error}", path.display()))
}

/// Name for saved files. It is the name of the run or of the file. If the run has several methods,
/// the name of the method follows.
fn base_name(kind: ModelKind, model: &Path) -> String {
    let full = model.canonicalize().unwrap_or_else(|_| model.to_owned());
    let name = |path: &Path| {
        let stem = if model.is_dir() {
            path.file_name()
        } else {
            path.file_stem()
        };
        stem.map_or_else(
            || "model".to_owned(),
            |stem| stem.to_string_lossy().into_owned(),
        )
    };
    let own = name(&full);
    match full.parent() {
        // The subfolder of a run with several methods.
        Some(run) if own == kind.name() => format!("{}-{own}", name(run)),
        _ => own,
    }
}

fn capitalized(text: &str) -> String {
    let mut letters = text.chars();
    letters
        .next()
        .map(|first| first.to_uppercase().chain(letters).collect())
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use model_files::splat::arrays::SplatArrays;
    use model_files::splat::file::{self, Format};
    use std::io::Read;

    fn splats() -> SplatArrays {
        SplatArrays {
            means: vec![[0.0, 0.0, 1.0]; 3],
            log_scales: vec![[-5.0; 3]; 3],
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; 3],
            opacity_logits: vec![1.0; 3],
            sh: vec![[0.1; 3]; 3],
            sh_degree: 0,
            is_antialiased: false,
        }
    }

    fn kind(name: &str) -> ModelKind {
        ModelKind::from_name(name).expect("registered")
    }

    fn content(file: &ServedFile) -> Vec<u8> {
        let mut content = Vec::new();
        let mut opened = (file.open)().expect("opened");
        opened.read_to_end(&mut content).expect("read");
        content
    }

    #[test]
    fn saved_splats_are_offered_as_saved_and_converted() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = folder.path().join("kitchen");
        std::fs::create_dir(&run).expect("disk space");
        file::write(&run.join(file::IN_FOLDER), Format::Ply, &splats()).expect("written");
        std::fs::write(run.join(report::FILE), "<!doctype html>").expect("written");
        let served = of_models([(kind("splat"), &run)].into_iter());
        let listed: Vec<_> = served
            .iter()
            .map(|file| (&*file.name, &*file.label, file.save_as.as_deref()))
            .collect();
        assert_eq!(
            listed,
            [
                ("splat.spz", "Splats (SPZ)", Some("kitchen.spz")),
                ("splat.ply", "Splats (PLY)", Some("kitchen.ply")),
                ("splat-report.html", "Report", None),
            ]
        );
        let saved = std::fs::read(run.join(file::IN_FOLDER)).expect("read");
        assert_eq!(content(&served[1]), saved);
        assert_eq!(content(&served[2]), b"<!doctype html>");
        let spz = folder.path().join("received.spz");
        std::fs::write(&spz, content(&served[0])).expect("written");
        assert_eq!(file::read(&spz).expect("an SPZ file").n_splats(), 3);
    }

    #[test]
    fn models_of_several_methods_have_different_names() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = folder.path().join("kitchen");
        let [splat, tsdf] = ["splat", "tsdf"].map(|method| run.join(method));
        for model in [&splat, &tsdf] {
            std::fs::create_dir_all(model).expect("disk space");
            std::fs::write(model.join(report::FILE), "").expect("written");
        }
        std::fs::write(tsdf.join("mesh.glb"), "glTF").expect("written");
        let models = [(kind("splat"), &splat), (kind("tsdf"), &tsdf)];
        let served = of_models(models.into_iter());
        let listed: Vec<_> = served
            .iter()
            .map(|file| (&*file.label, file.save_as.as_deref()))
            .collect();
        assert_eq!(
            listed,
            [
                ("Splats (SPZ)", Some("kitchen-splat.spz")),
                ("Splats (PLY)", Some("kitchen-splat.ply")),
                ("Report of splat", None),
                // There is no mesh.ply, and making one would need the GPU.
                ("Mesh (GLB)", Some("kitchen-tsdf.glb")),
                ("Report of tsdf", None),
            ]
        );
        assert_eq!(content(&served[3]), b"glTF");
        std::fs::remove_file(tsdf.join("mesh.glb")).expect("removed");
        let reason = (served[3].open)().expect_err("it was removed");
        assert!(reason.contains("has no .glb any more"), "{reason}");
    }

    #[test]
    fn foreign_file_is_offered_itself() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("guitar.compressed.ply");
        file::write(&path, Format::Ply, &splats()).expect("written");
        let served = of_models([(kind("splat"), &path)].into_iter());
        let names: Vec<_> = served.iter().map(|file| file.save_as.as_deref()).collect();
        assert_eq!(
            names,
            [Some("guitar.compressed.spz"), Some("guitar.compressed.ply")]
        );
        let saved = std::fs::read(&path).expect("read");
        assert_eq!(content(&served[1]), saved);
    }
}
