//! Where the results of a run go, and what its report says.

use crate::config::Rig;
use crate::exit::BadArgument;
use crate::method::Kind;
use anyhow::{Context, ensure};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use trainer::{Keyframe, Method};

/// The files of a saved model: what `checkpoint_sha256` covers, in this order.
const MODEL_FILES: [&str; 6] = ["model.json", "mesh.ply", "mesh.glb", "field.blocks", "field.nerf", "splats.ply"];
/// Where a model lies until it is whole.
const UNFINISHED: &str = "model.part";
/// What training needs to go on, in the folder of a run.
pub(crate) const CHECKPOINT: &str = "training.ckpt";
/// Held while a run writes into a folder.
const LOCK: &str = ".lock";
const SECS_PER_DAY: u64 = 86_400;

/// Refuses a folder that holds a model, or several: results of two runs never mix, and none is replaced.
pub(crate) fn refuse_model(folder: &Path) -> Result<(), BadArgument> {
    let places = [PathBuf::new()].into_iter().chain(Kind::ALL.map(|kind| PathBuf::from(kind.name())));
    let mut files = places.flat_map(|place| MODEL_FILES.map(|name| place.join(name)));
    match files.find(|file| folder.join(file).exists()) {
        Some(file) => Err(BadArgument(format!(
            "--out {}: the folder holds a model already ({}), name another one",
            folder.display(),
            file.display()
        ))),
        None => Ok(()),
    }
}

/// Refuses the folder of a run of several methods where one model is meant, and names theirs.
pub(crate) fn expect_one_model(folder: &Path) -> Result<(), BadArgument> {
    let holds_one = |folder: &Path| MODEL_FILES.iter().chain([&CHECKPOINT]).any(|name| folder.join(name).exists());
    let inside: Vec<String> = Kind::ALL
        .into_iter()
        .map(|kind| folder.join(kind.name()))
        .filter(|folder| holds_one(folder))
        .map(|folder| folder.display().to_string())
        .collect();
    if inside.is_empty() || holds_one(folder) {
        return Ok(());
    }
    Err(BadArgument(format!("{}: a folder for each method lies in it, name {}", folder.display(), inside.join(" or "))))
}

/// Makes the folder of each model of a run: the one asked for where there is one model, else one inside it by the name of its
/// method. The settled rig file, where there is one, is written into each: beside a model the one that makes it alone.
pub(crate) fn make_each(asked: Option<&Path>, kinds: &[Kind], rig: Option<&Rig>) -> anyhow::Result<Vec<PathBuf>> {
    let write = |rig: &Rig, folder: &Path| {
        rig.write_settled(folder).with_context(|| format!("cannot write into {}", folder.display()))
    };
    let out = make(asked)?;
    let folders: Vec<PathBuf> = match kinds {
        [_] => vec![out.clone()],
        several => several.iter().map(|kind| make(Some(&out.join(kind.name())))).collect::<anyhow::Result<_>>()?,
    };
    if let Some(rig) = rig {
        write(rig, &out)?;
        for (kind, folder) in kinds.iter().zip(&folders) {
            write(&rig.with_method(*kind), folder)?;
        }
    }
    Ok(folders)
}

/// Makes the folder asked for, or `runs/<UTC time>`; one that holds a model is refused.
pub(crate) fn make(asked: Option<&Path>) -> anyhow::Result<PathBuf> {
    if let Some(folder) = asked {
        if folder.to_str().is_none() {
            return Err(
                BadArgument(format!("--out {}: the name must be UTF-8, reports hold it", folder.display())).into()
            );
        }
        refuse_model(folder)?;
        std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
        lock(folder)?;
        return Ok(folder.to_owned());
    }
    #[expect(clippy::disallowed_methods, reason = "a name for people; nothing is measured by it")]
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    std::fs::create_dir_all("runs").context("cannot make the folder runs")?;
    let name = name_from_time(since_epoch);
    for attempt in 1..100 {
        let folder = match attempt {
            1 => PathBuf::from(format!("runs/{name}")),
            _ => PathBuf::from(format!("runs/{name}-{attempt}")),
        };
        match std::fs::create_dir(&folder) {
            Ok(()) => {
                lock(&folder)?;
                return Ok(folder);
            }
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error).with_context(|| format!("cannot make the folder {}", folder.display())),
        }
    }
    anyhow::bail!("runs/{name} and ninety-eight more exist already: name a folder with --out")
}

/// Keeps other runs out of a folder as long as this process lives.
fn lock(folder: &Path) -> anyhow::Result<()> {
    let place = folder.join(LOCK);
    let file = std::fs::File::create(&place).with_context(|| format!("cannot write {}", place.display()))?;
    match file.try_lock() {
        Ok(()) => std::mem::forget(file), // The system lets go of it when the process ends, however it ends.
        Err(std::fs::TryLockError::WouldBlock) => {
            let told = format!("--out {}: another run writes into this folder, name another one", folder.display());
            return Err(BadArgument(told).into());
        }
        Err(std::fs::TryLockError::Error(error)) => log::debug!("{}: no lock: {error}", place.display()),
    }
    Ok(())
}

/// Saves a model beside its place first and moves it there when it is whole.
pub(crate) fn save_model(method: &mut dyn Method, folder: &Path) -> anyhow::Result<()> {
    let unfinished = folder.join(UNFINISHED);
    if unfinished.exists() {
        // Of a run that was killed while it saved.
        std::fs::remove_dir_all(&unfinished).with_context(|| format!("cannot remove {}", unfinished.display()))?;
    }
    method.save(&unfinished)?;
    // Splats and blocks come last: a folder that holds them holds the whole model.
    for name in MODEL_FILES.iter().filter(|name| unfinished.join(name).exists()) {
        let place = folder.join(name);
        std::fs::rename(unfinished.join(name), &place).with_context(|| format!("cannot write {}", place.display()))?;
    }
    // A file that is not listed above would be lost: the folder has to be empty now.
    std::fs::remove_dir(&unfinished).with_context(|| format!("cannot remove {}", unfinished.display()))
}

/// Writes a report as readable JSON.
pub(crate) fn write_json(path: &Path, report: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(report).context("cannot write the report as JSON")?;
    text.push('\n');
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

/// Writes which keyframes were used, and what for, for `--keyframes`.
pub(crate) fn write_keyframe_list(path: &Path, keyframes: &[Arc<Keyframe>]) -> anyhow::Result<()> {
    std::fs::write(path, crate::join::keyframe_list(keyframes.iter()))
        .with_context(|| format!("cannot write {}", path.display()))
}

/// SHA-256 over the model files of a folder, each preceded by its name and length.
pub(crate) fn checkpoint_sha256(folder: &Path) -> anyhow::Result<String> {
    let mut hash = Sha256::new();
    let mut n_files = 0;
    for name in MODEL_FILES {
        let path = folder.join(name);
        if !path.exists() {
            continue;
        }
        let bytes = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        hash.update(format!("{name} {}\n", bytes.len()));
        hash.update(&bytes);
        n_files += 1;
    }
    ensure!(n_files > 0, "{} holds no model", folder.display());
    Ok(hex(&hash.finalize()))
}

/// Bytes as people write them.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// `20261121-093000` for a time since 1970, UTC.
fn name_from_time(since_epoch: Duration) -> String {
    let secs = since_epoch.as_secs();
    let (year, month, day) = date_from_days(secs / SECS_PER_DAY);
    let of_day = secs % SECS_PER_DAY;
    format!("{year:04}{month:02}{day:02}-{:02}{:02}{:02}", of_day / 3600, of_day / 60 % 60, of_day % 60)
}

/// Year, month and day of a day counted from 1 January 1970.
fn date_from_days(mut days: u64) -> (u64, usize, u64) {
    let is_leap = |year: u64| year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
    let mut year = 1970;
    while days >= 365 + u64::from(is_leap(year)) {
        days -= 365 + u64::from(is_leap(year));
        year += 1;
    }
    let lengths = [31, 28 + u64::from(is_leap(year)), 31, 30, 31, 30, 31, 31, 30, 31, 30, 31];
    let mut month_ix = 0;
    while days >= lengths[month_ix] {
        days -= lengths[month_ix];
        month_ix += 1;
    }
    (year, month_ix + 1, days + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_are_named_by_utc() {
        assert_eq!(name_from_time(Duration::ZERO), "19700101-000000");
        assert_eq!(name_from_time(Duration::from_secs(951_782_400)), "20000229-000000");
        assert_eq!(name_from_time(Duration::from_secs(1_795_253_400)), "20261121-093000");
        assert_eq!(name_from_time(Duration::from_secs(4_102_444_799)), "20991231-235959");
    }

    #[test]
    fn a_folder_with_a_model_is_refused_and_named() {
        let folder = tempfile::tempdir().expect("folder");
        assert_eq!(make(Some(folder.path())).expect("an empty folder"), folder.path());
        std::fs::write(folder.path().join("model.json"), b"{}").expect("file");
        let told = make(Some(folder.path())).expect_err("a model").to_string();
        assert!(told.contains(folder.path().to_str().expect("plain")) && told.contains("model.json"), "{told}");
    }

    #[test]
    fn several_models_lie_in_folders_of_their_own_and_are_found() {
        let folder = tempfile::tempdir().expect("folder");
        let asked = folder.path().join("out");
        let made = make_each(Some(&asked), &[Kind::Tsdf, Kind::Splat], None).expect("it is free");
        assert_eq!(made, [asked.join("tsdf"), asked.join("splat")]);
        expect_one_model(&asked).expect("there is none yet");
        std::fs::write(made[0].join(CHECKPOINT), b"{}").expect("file");
        std::fs::write(made[1].join("splats.ply"), b"{}").expect("file");
        let told = expect_one_model(&asked).expect_err("two").0;
        assert!(told.contains("out/splat or ") && told.ends_with("out/tsdf"), "{told}");
        expect_one_model(&made[1]).expect("one");
        let told = refuse_model(&asked).expect_err("one inside").0;
        assert!(told.contains("splat/splats.ply"), "{told}");
    }

    #[test]
    fn two_runs_do_not_write_into_one_folder() {
        let folder = tempfile::tempdir().expect("folder");
        make(Some(folder.path())).expect("the first");
        let told = make(Some(folder.path())).expect_err("the second").to_string();
        assert!(told.contains("another run writes into this folder"), "{told}");
    }

    #[test]
    fn the_checksum_sees_every_byte_and_every_name() {
        let folder = tempfile::tempdir().expect("folder");
        assert!(checkpoint_sha256(folder.path()).is_err(), "no model, no checksum");
        std::fs::write(folder.path().join("splats.ply"), b"abc").expect("file");
        let first = checkpoint_sha256(folder.path()).expect("a model");
        std::fs::write(folder.path().join("report.json"), b"other").expect("file");
        assert_eq!(checkpoint_sha256(folder.path()).expect("a model"), first);
        std::fs::write(folder.path().join("splats.ply"), b"abd").expect("file");
        assert_ne!(checkpoint_sha256(folder.path()).expect("a model"), first);
    }
}
