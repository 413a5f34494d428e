//! Saves edited splats of a file, which has no folder for edits, as a new file beside it.

use anyhow::{Context, ensure};
use model_files::Edits;
use model_files::splat::file::{self, Format};
use std::path::{Path, PathBuf};

/// Maximum number of copies of a file, so that a search for a free name ends.
const MAX_COPIES: usize = 10_000;

/// Writes the splats of a file that are not in erased space to a new file in the same folder.
/// Returns the path of the new file, or `None` if nothing is erased. Existing files are never
/// replaced. If the name is in use, the name of the new file gets a number.
///
/// SPZ files are copied as SPZ. All other files become PLY files with values at full precision.
///
/// # Errors
///
/// If the file cannot be read, or the new one cannot be written.
pub(crate) fn save(model: &Path, edits: &Edits) -> anyhow::Result<Option<PathBuf>> {
    if edits.is_empty() {
        return Ok(None);
    }
    let splats = file::read(model)?.without_erased(edits);
    ensure!(
        splats.n_splats() > 0,
        "all splats of {} are erased; undo an edit first",
        model.display()
    );
    let is_spz = model
        .extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("spz"));
    let (format, extension) = if is_spz {
        (Format::Spz, "spz")
    } else {
        (Format::Ply, "ply")
    };
    let out = (1..=MAX_COPIES)
        .map(|number| path_of_copy(model, number, extension))
        // A broken symbolic link also occupies the name.
        .find(|out| out.symlink_metadata().is_err())
        .with_context(|| {
            format!(
                "{} has {MAX_COPIES} edited copies already; remove some",
                model.display()
            )
        })?;
    // Fails if another program creates the file meanwhile.
    files::create_from(&out, |partial| {
        file::write(partial, format, &splats).map_err(anyhow::Error::from)
    })
    .with_context(|| format!("cannot write {}", out.display()))?;
    Ok(Some(out))
}

/// Path of an edited copy: `scan-edited.ply`, then `scan-edited-2.ply` and so on.
fn path_of_copy(model: &Path, number: usize, extension: &str) -> PathBuf {
    let stem = model.file_stem().unwrap_or_default().to_string_lossy();
    // The double extension of SuperSplat's packed files.
    let stem = stem.strip_suffix(".compressed").unwrap_or(&stem);
    let suffix = if number == 1 {
        String::new()
    } else {
        format!("-{number}")
    };
    model.with_file_name(format!("{stem}-edited{suffix}.{extension}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Transform;
    use model_files::Aabb;
    use model_files::edits::Edit;
    use model_files::splat::cloud::synthetic_cloud;

    /// Erases the half of space with positive x.
    fn half() -> Edits {
        let mut edits = Edits::default();
        let aabb = Aabb {
            world_from_box: Transform::identity(),
            min_m: [0.0, -1e3, -1e3],
            max_m: [1e3; 3],
        };
        edits.push(Edit::Box(aabb)).expect("a valid box");
        edits
    }

    #[test]
    fn copies_lack_erased_splats_and_replace_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let splats = synthetic_cloud(50, 1);
        let left = splats.clone().without_erased(&half());
        assert!(left.n_splats() > 0 && left.n_splats() < 50);
        file::write(&at("scan.ply"), Format::Ply, &splats).expect("a file");
        let original = std::fs::read(at("scan.ply")).expect("a file");
        assert_eq!(
            save(&at("scan.ply"), &Edits::default()).expect("no edits"),
            None
        );
        for name in ["scan-edited.ply", "scan-edited-2.ply", "scan-edited-3.ply"] {
            let saved = save(&at("scan.ply"), &half()).expect("a copy");
            assert_eq!(saved, Some(at(name)));
            assert_eq!(file::read(&at(name)).expect("splats").means, left.means);
        }
        assert_eq!(std::fs::read(at("scan.ply")).expect("a file"), original);
        let entries = std::fs::read_dir(folder.path()).expect("a folder");
        assert_eq!(entries.count(), 4, "no temporary files are left");
        #[cfg(unix)]
        {
            let link = at("scan-edited-4.ply");
            std::os::unix::fs::symlink(at("gone.ply"), &link).expect("a link");
            let saved = save(&at("scan.ply"), &half()).expect("a copy");
            assert_eq!(saved, Some(at("scan-edited-5.ply")), "not through a link");
        }
    }

    #[test]
    fn copies_have_a_format_that_can_be_written() {
        let folder = tempfile::tempdir().expect("a folder");
        let splats = synthetic_cloud(50, 1);
        for (name, format, copy) in [
            ("a.spz", Format::Spz, "a-edited.spz"),
            ("b.compressed.ply", Format::Ply, "b-edited.ply"),
            ("c", Format::Ply, "c-edited.ply"),
        ] {
            let path = folder.path().join(name);
            file::write(&path, format, &splats).expect("a file");
            let saved = save(&path, &half()).expect("a copy");
            assert_eq!(saved, Some(folder.path().join(copy)));
        }
    }

    #[test]
    fn empty_copies_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("scan.ply");
        file::write(&path, Format::Ply, &synthetic_cloud(5, 1)).expect("a file");
        let mut edits = Edits::default();
        let aabb = Aabb {
            world_from_box: Transform::identity(),
            min_m: [-1e3; 3],
            max_m: [1e3; 3],
        };
        edits.push(Edit::Box(aabb)).expect("a valid box");
        let error = save(&path, &edits).expect_err("nothing is left");
        assert!(error.to_string().contains("undo"), "{error:#}");
        let entries = std::fs::read_dir(folder.path()).expect("a folder");
        assert_eq!(entries.count(), 1);
    }
}
