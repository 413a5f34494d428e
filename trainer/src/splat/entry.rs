//! Registers splats as a method.

use super::{SplatOptions, SplatTrainer};
use crate::method_entry::{
    Export, ExportRequest, ExportWriter, Exported, MethodEntry, SingleFile, boxed,
};
use crate::model_options::{MethodOptions, default_options};
use crate::{Error, Method};
use calibration::ParamSet;
use gpu::Gpu;
use model_files::Edits;
use model_files::splat::file::{self, EXTENSIONS, Format, IN_FOLDER, UNSUPPORTED};
use std::path::Path;
use std::sync::Arc;

/// Entry of the splat method.
pub(crate) static ENTRY: MethodEntry = MethodEntry {
    name: SplatOptions::METHOD,
    description: "Gaussian splats",
    model: "a splat model",
    primitive: "splat",
    primitives_label: "Splats",
    files: &[IN_FOLDER],
    single_file: Some(SingleFile {
        description: "a file of splats",
        extensions: &EXTENSIONS,
        unsupported_extensions: &UNSUPPORTED,
    }),
    needs_depth: false,
    can_revise: true,
    has_chunks: true,
    learnable: ParamSet::EXTRINSICS
        .union(ParamSet::TIME_OFFSET)
        .union(ParamSet::LENS)
        .union(ParamSet::IMAGE_POSES)
        .union(ParamSet::IMAGE_GAINS),
    exports: &[
        Export {
            format: "spz",
            contents: "splats",
            has_cells: false,
            write: ExportWriter::Cpu(write_spz),
        },
        Export {
            format: "ply",
            contents: "splats",
            has_cells: false,
            write: ExportWriter::Cpu(write_ply),
        },
    ],
    default_options: default_options::<SplatOptions>,
    check_options: |options| options.typed::<SplatOptions>().map(drop),
    start: |gpu, options| Ok(Box::new(SplatTrainer::new(gpu, options.typed()?)?)),
    resume: |gpu, checkpoint, keyframes| {
        SplatTrainer::resume(gpu, checkpoint, keyframes).map(boxed)
    },
    load,
};

fn load(gpu: Arc<Gpu>, model: &Path) -> Result<Box<dyn Method>, Error> {
    let splats = file::read(model)?;
    // The limit applies only to training. A saved model is always loaded completely.
    let max_splats = u32::try_from(splats.n_splats()).unwrap_or(u32::MAX);
    let options = SplatOptions {
        max_splats,
        ..SplatOptions::default()
    };
    let trainer = SplatTrainer::from_arrays(gpu, options.into(), &splats)?;
    // Only the folder of a saved model has camera corrections.
    Ok(Box::new(if model.is_dir() {
        trainer.with_saved_metadata(model)?
    } else {
        trainer
    }))
}

fn write_ply(request: &ExportRequest<'_>) -> Result<Exported, Error> {
    write(request, Format::Ply)
}

fn write_spz(request: &ExportRequest<'_>) -> Result<Exported, Error> {
    write(request, Format::Spz)
}

/// Validates the splats of a model and writes them to a file.
fn write(request: &ExportRequest<'_>, format: Format) -> Result<Exported, Error> {
    // Edits are stored beside the model, and are applied only now.
    let splats = file::read(request.model)?.without_erased(&Edits::read(request.model)?);
    file::write(request.out, format, &splats)?;
    let detail = format!("of SH degree {}", splats.sh_degree);
    Ok(Exported {
        n_items: splats.n_splats() as u64,
        item: "splat",
        detail,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use gpu::testing::test_gpu;
    use model_files::splat::arrays::SplatArrays;
    use model_files::splat::ply;

    #[test]
    fn saved_model_above_the_training_limit_is_loaded_completely() {
        let n_splats = SplatOptions::default().max_splats as usize + 1;
        let splats = SplatArrays {
            means: vec![[0.0, 0.0, 1.0]; n_splats],
            log_scales: vec![[-5.0; 3]; n_splats],
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; n_splats],
            opacity_logits: vec![1.0; n_splats],
            sh: vec![[0.1; 3]; n_splats],
            sh_degree: 0,
            is_antialiased: false,
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("large.ply");
        ply::write(&path, &splats).unwrap();
        let model = load(test_gpu(), &path).unwrap();
        assert_eq!(model.progress().primitives, n_splats as u64);
    }
}
