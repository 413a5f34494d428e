//! The folder of a run and its files.

use crate::resume_command::ResumeCommand;
use crate::steering::steering_log;
use anyhow::{Context, bail, ensure};
use capture::check_output_folder;
use capture::config::Rig;
use drivers::recording::RIG_FILE;
use keyframe::Keyframe;
use messages::{BadInput, Setting, listed};
use model_files::Edits;
use model_files::checkpoint::Checkpoint;
use serde::Serialize;
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use trainer::{AlignedModel, ModelKind};

/// File extension of recordings.
const RECORDING_EXTENSION: &str = "mcap";
/// Parent folder of runs without `--out`.
pub const RUNS: &str = "runs";
/// Base name of the temporary subfolder in which a model is saved until it is complete.
pub(crate) const MODEL: &str = "model";
/// The checkpoint in the folder of a run.
pub const CHECKPOINT: &str = "training.ckpt";
/// Subfolder with the keyframes of a run.
pub(crate) const KEYFRAMES: &str = "keyframes";
/// The report on a saved model.
pub(crate) const REPORT: &str = "report.json";
/// The log of a run.
pub const LOG: &str = "log.txt";
/// The older part of a long log.
pub const OLDER_LOG: &str = "log.1.txt";
/// Lock file, held while a run writes into a folder.
pub(crate) const LOCK: &str = ".lock";
const SECS_PER_DAY: u64 = 86_400;

/// Returns an error if a folder contains any model, so that results are never mixed or overwritten.
pub fn check_no_model(folder: &Path) -> anyhow::Result<()> {
    // A run of several methods has one subfolder per method. The empty path is the folder itself.
    let subfolders = [PathBuf::new()]
        .into_iter()
        .chain(ModelKind::ALL.iter().map(|kind| PathBuf::from(kind.name())));
    let mut files = subfolders.flat_map(|path| {
        ModelKind::model_files()
            .map(|name| path.join(name))
            .collect::<Vec<_>>()
    });
    match files.find(|file| folder.join(file).exists()) {
        Some(file) => Err(BadInput(format!(
            "{} {}: the folder already contains a model ({}); give another folder",
            Setting::Out,
            folder.display(),
            file.display()
        ))
        .into()),
        None => Ok(()),
    }
}

/// Returns an error if a folder contains any interrupted run, because a new run would replace its
/// checkpoint.
///
/// * `resume_command`: continues a run with the input of the new run.
fn check_no_unfinished_run(out: &Path, resume_command: &ResumeCommand) -> anyhow::Result<()> {
    let folders = std::iter::once(out.to_owned())
        .chain(ModelKind::ALL.iter().map(|kind| out.join(kind.name())));
    match folders
        .into_iter()
        .find(|folder| folder.join(CHECKPOINT).exists())
    {
        Some(folder) => Err(BadInput(format!(
            "{} {}: {} contains an interrupted run: `{}` continues it; or give another folder",
            Setting::Out,
            out.display(),
            folder.display(),
            resume_command.line(&folder)
        ))
        .into()),
        None => Ok(()),
    }
}

/// Checks the folder for the results of a run: it must be writable, and if it was requested, the
/// results of another run would be overwritten.
///
/// * `resume`: folder of the run that is continued.
/// * `data`: folder of the data.
/// * `resume_command`: continues a run with the same input.
pub(crate) fn check_out(
    out: Option<&Path>,
    resume: Option<&Path>,
    data: Option<&Path>,
    resume_command: &ResumeCommand,
) -> anyhow::Result<()> {
    // A run that is continued may be finished, and then writes nothing.
    if out.is_some() || resume.is_none() {
        check_output_folder(Setting::Out, out.unwrap_or(Path::new(RUNS)))?;
    }
    let Some(out) = out else { return Ok(()) };
    check_no_model(out)?;
    if let Some(data) = data {
        check_not_data_folder(out, data)?;
    }
    if resume == Some(out) {
        Ok(())
    } else {
        check_no_unfinished_run(out, resume_command)
    }
}

/// Returns an error if results would be written into the folder of the data.
pub fn check_not_data_folder(out: &Path, data: &Path) -> anyhow::Result<()> {
    // The same folder may have several names, for example through a link. A folder that does not
    // exist yet has no canonical path, and cannot be the folder of the data.
    let canonical = |path: &Path| path.canonicalize().ok();
    match (canonical(out), canonical(data)) {
        (Some(folder), Some(data)) if folder == data => Err(BadInput(format!(
            "{} {}: this is the folder of the data; give another folder",
            Setting::Out,
            out.display()
        ))
        .into()),
        _ => Ok(()),
    }
}

/// Returns an error if a folder contains models only in subfolders for several methods. The error
/// lists the subfolders.
pub fn expect_one_model(folder: &Path) -> anyhow::Result<()> {
    let holds_one = |folder: &Path| holds_model(folder) || folder.join(CHECKPOINT).exists();
    let inside: Vec<String> = ModelKind::ALL
        .iter()
        .map(|kind| folder.join(kind.name()))
        .filter(|folder| holds_one(folder))
        .map(|folder| folder.display().to_string())
        .collect();
    if inside.is_empty() || holds_one(folder) {
        return Ok(());
    }
    Err(BadInput(format!(
        "{}: the folder contains several methods; give {}",
        folder.display(),
        inside.join(" or ")
    ))
    .into())
}

/// Returns an error unless the path is a model: an existing folder with exactly one model, or a
/// file of splats.
pub fn expect_model(model: &Path) -> anyhow::Result<()> {
    let shown = model.display();
    ensure!(model.exists(), "{shown} does not exist");
    if model.is_dir() {
        expect_one_model(model)?;
        if holds_model(model) {
            return Ok(());
        }
        let has_checkpoint = model.join(CHECKPOINT).exists();
        let hint = if has_checkpoint {
            format!(
                " but has a checkpoint: `{}` continues from it",
                resume_command_of(model).line(model)
            )
        } else {
            String::new()
        };
        bail!("{shown} contains no model{hint}");
    }
    // One file of a model with several files may have the extension of a single-file model.
    let is_part = ModelKind::ALL
        .iter()
        .any(|kind| is_part_of_model(*kind, model));
    if is_part || ModelKind::of_single_file(model).is_none() {
        let single_files = ModelKind::ALL
            .iter()
            .filter_map(|kind| kind.entry().single_file);
        let described: Vec<String> = single_files
            .map(|file| format!("{} (.{})", file.description, file.extensions.join(", .")))
            .collect();
        let described = listed(
            &described.iter().map(String::as_str).collect::<Vec<_>>(),
            "or",
        );
        let message = format!("{shown} is not {described}; for a saved model, give its folder");
        return Err(BadInput(message).into());
    }
    Ok(())
}

/// The command that continues the run in a folder, as far as the folder shows it.
fn resume_command_of(folder: &Path) -> ResumeCommand {
    // Only live runs store keyframes. They also store their rig file and their input.
    if folder.join(KEYFRAMES).exists() {
        let checkpoint = Checkpoint::read(&folder.join(CHECKPOINT));
        let flags = checkpoint.map_or_else(|_| BTreeMap::new(), |checkpoint| checkpoint.flags);
        ResumeCommand::of_live_run(&flags, &folder.join(RIG_FILE))
    } else {
        // The folder does not contain the path of the data.
        ResumeCommand::of_data(Path::new("DATA"))
    }
}

/// The content of the report in a model's folder; `Null` if there is none.
pub(crate) fn report(model: &Path) -> Value {
    // Splat files of other programs have no report.
    let text = files::read_text(&model.join(REPORT)).unwrap_or_default();
    serde_json::from_str(&text).unwrap_or_default()
}

/// Whether a file is one of several that a model of this kind consists of.
fn is_part_of_model(kind: ModelKind, path: &Path) -> bool {
    let entry = kind.entry();
    // The last file of a method with a single-file form is a complete model.
    let is_complete = |file: &str| entry.single_file.is_some() && entry.files.last() == Some(&file);
    entry
        .files
        .iter()
        .any(|file| path.ends_with(file) && !is_complete(file))
}

/// Whether a folder contains any file of a saved model.
pub(crate) fn holds_model(folder: &Path) -> bool {
    ModelKind::model_files().any(|name| folder.join(name).exists())
}

/// The models at a path: the path itself or, for a run of several methods, the subfolders that
/// contain a model. If there is no model, returns the error of [`expect_model`].
pub fn models_at(path: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let inside = ModelKind::ALL
        .iter()
        .map(|kind| path.join(kind.name()))
        .filter(|folder| holds_model(folder));
    let inside: Vec<PathBuf> = inside.collect();
    if path.is_dir() && !holds_model(path) && !inside.is_empty() {
        return Ok(inside);
    }
    expect_model(path)?;
    Ok(vec![path.to_owned()])
}

/// Folders created by this run. They are removed if the run is rejected, or fails at its start.
#[derive(Debug, Default)]
pub struct CreatedFolders {
    /// Folders of the run, the innermost first.
    leaves: Vec<PathBuf>,
    /// Parents of `leaves` that were also created, the innermost first.
    parents: Vec<PathBuf>,
}

impl CreatedFolders {
    /// Creates the folder of each model of a run. A single model gets the requested folder. Several
    /// models get one subfolder per method. If there is a resolved rig file, writes it into each
    /// folder. In a subfolder, the rig file lists only the method of that model.
    pub fn make_each(
        &mut self,
        requested: Option<&Path>,
        kinds: &[ModelKind],
        rig: Option<&Rig>,
    ) -> anyhow::Result<Vec<PathBuf>> {
        let out = self.make(requested)?;
        let folders: Vec<PathBuf> = match kinds {
            [_] => vec![out.clone()],
            several => several
                .iter()
                .map(|kind| self.make(Some(&out.join(kind.name()))))
                .collect::<anyhow::Result<_>>()?,
        };
        if let Some(rig) = rig {
            write_rig(rig, &out)?;
            // With a single model, this replaces the rig file that was written above.
            for (kind, folder) in kinds.iter().zip(&folders) {
                write_rig(&rig.with_method(kind.name()), folder)?;
            }
        }
        Ok(folders)
    }

    /// Creates the requested folder, or `runs/<UTC time>`. A folder that already contains a model
    /// is an error.
    pub fn make(&mut self, requested: Option<&Path>) -> anyhow::Result<PathBuf> {
        // The missing folders are listed before they are created, so that a rejected run removes
        // only the folders that it has created.
        let runs = missing_folders(Path::new(RUNS));
        let missing_parents = requested.map_or(Vec::new(), missing_folders);
        let created = make(requested)?;
        match (requested, missing_parents.split_first()) {
            (None, _) => {
                self.leaves.insert(0, created.clone());
                self.parents.splice(0..0, runs);
            }
            (Some(_), Some((leaf, parents))) => {
                self.leaves.insert(0, leaf.clone());
                self.parents.splice(0..0, parents.iter().cloned());
            }
            (Some(_), None) => {} // The folder already existed.
        }
        Ok(created)
    }

    /// Removes the created folders with their contents, unless they contain a model, a checkpoint
    /// or a recording.
    pub fn remove_created(self) {
        if self.leaves.iter().any(|folder| must_keep(folder)) {
            return;
        }
        let removed = self.leaves.iter().try_for_each(std::fs::remove_dir_all);
        // `remove_dir` keeps a folder that is not empty because another program wrote into it.
        let removed = removed.and_then(|()| self.parents.iter().try_for_each(std::fs::remove_dir));
        if let Err(error) = removed {
            log::debug!("cannot remove a folder of the rejected run: {error}");
        }
    }

    /// Removes the created folders if the command was rejected because of bad input or insufficient
    /// data, or failed before it had anything to keep.
    pub fn keep_unless(self, is_rejected: bool) {
        if is_rejected {
            self.remove_created();
        }
    }
}

/// Writes the resolved rig file into a folder.
fn write_rig(rig: &Rig, folder: &Path) -> anyhow::Result<()> {
    rig.write_resolved(folder)
        .map(drop)
        .with_context(|| format!("cannot write into {}", folder.display()))
}

/// A folder and its parents, as far as they do not exist, the innermost first.
fn missing_folders(folder: &Path) -> Vec<PathBuf> {
    folder
        .ancestors()
        // The last ancestor of a relative path is empty; it means the current folder.
        .take_while(|folder| !folder.as_os_str().is_empty() && !folder.exists())
        .map(Path::to_owned)
        .collect()
}

/// Whether a folder contains results that must not be removed.
fn must_keep(folder: &Path) -> bool {
    holds_recording(folder)
        || holds_model(folder)
        || folder.join(CHECKPOINT).exists()
        || folder.join(steering_log::FILE).exists()
}

/// Whether a folder contains a recording.
fn holds_recording(folder: &Path) -> bool {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .map(|entry| entry.path())
        .any(|path| is_recording(&path))
}

fn make(requested: Option<&Path>) -> anyhow::Result<PathBuf> {
    if let Some(folder) = requested {
        // `report.json` and the next commands contain the name, and JSON is UTF-8.
        if folder.to_str().is_none() {
            return Err(BadInput(format!(
                "{} {}: the name must be valid UTF-8",
                Setting::Out,
                folder.display()
            ))
            .into());
        }
        check_no_model(folder)?;
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot create the folder {}", folder.display()))?;
        // Two runs with the same `--out` may both have passed the check above.
        lock(folder)?;
        return Ok(folder.to_owned());
    }
    make_in(Path::new(RUNS), "")
}

/// Creates a folder in the system's temporary folder, for a model that cannot be saved in its run
/// folder.
pub fn make_fallback_folder() -> anyhow::Result<PathBuf> {
    make_in(&std::env::temp_dir(), "fieldrig-")
}

/// Creates a new folder named after the current time.
fn make_in(parent: &Path, prefix: &str) -> anyhow::Result<PathBuf> {
    #[expect(
        clippy::disallowed_methods,
        reason = "only a readable name; no time is measured"
    )]
    let since_epoch = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    std::fs::create_dir_all(parent)
        .with_context(|| format!("cannot create the folder {}", parent.display()))?;
    let name = format!("{prefix}{}", name_from_time(since_epoch));
    for attempt in 1..100 {
        let folder = match attempt {
            1 => parent.join(&name),
            _ => parent.join(format!("{name}-{attempt}")),
        };
        // `create_dir` fails if the folder exists. If two runs start in the same second, only one
        // of them gets the folder.
        match std::fs::create_dir(&folder) {
            Ok(()) => {
                lock(&folder)?;
                return Ok(folder);
            }
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => {
                return Err(error)
                    .with_context(|| format!("cannot create the folder {}", folder.display()));
            }
        }
    }
    bail!(
        "{} and 98 numbered variants already exist: give a folder with {}",
        parent.join(name).display(),
        Setting::Out
    )
}

/// Locks a folder against other runs for the lifetime of this process. A folder whose subfolders
/// are links is rejected. It may come from somebody else, and files written through its links would
/// replace other files.
pub(crate) fn lock(folder: &Path) -> anyhow::Result<()> {
    let of_methods = ModelKind::ALL.iter().map(|kind| kind.name());
    let subfolders = std::iter::once(KEYFRAMES)
        .chain(of_methods)
        .map(|name| folder.join(name));
    for subfolder in subfolders.chain([partial_model(folder)]) {
        files::check_no_link(&subfolder).map_err(|link| BadInput(link.to_string()))?;
    }
    let path = folder.join(LOCK);
    match files::lock(&path).with_context(|| format!("cannot write {}", path.display()))? {
        Some(file) => std::mem::forget(file), // The system releases the lock when the process ends.
        None => {
            let message = format!(
                "{} {}: another run uses this folder; give another one",
                Setting::Out,
                folder.display()
            );
            return Err(BadInput(message).into());
        }
    }
    Ok(())
}

/// Temporary subfolder in which a model is saved until it is complete.
fn partial_model(folder: &Path) -> PathBuf {
    files::partial::path_of(&folder.join(MODEL))
}

/// Saves a model and its edits in a temporary subfolder and moves its files into place once it is
/// complete.
pub fn save_model(method: &mut AlignedModel, edits: &Edits, folder: &Path) -> anyhow::Result<()> {
    let partial_folder = partial_model(folder);
    // The temporary subfolder is left over if an earlier run was killed while saving. No other run
    // saves now, because this run has locked the folder.
    let model_files: Vec<&OsStr> = ModelKind::model_files().map(OsStr::new).collect();
    files::partial::remove_leftover(&partial_folder, &model_files)?;
    let saved = method.save(&partial_folder).and_then(|()| {
        if edits.is_empty() {
            Ok(())
        } else {
            method.model_mut().write_for_others(&partial_folder, edits)
        }
    });
    if let Err(error) = saved {
        let _ = std::fs::remove_dir_all(&partial_folder); // Frees the disk space of the incomplete model.
        return Err(error.into());
    }
    // The edits are written before the model, because a complete model without its edits would show
    // erased parts.
    edits.write(folder)?;
    // A model counts as complete once the last file of its method is in place.
    for name in ModelKind::model_files().filter(|name| partial_folder.join(name).exists()) {
        let path = folder.join(name);
        std::fs::rename(partial_folder.join(name), &path)
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    // Fails if the folder is not empty, so that files missing from `model_files` are not lost.
    std::fs::remove_dir(&partial_folder)
        .with_context(|| format!("cannot remove {}", partial_folder.display()))
}

/// Writes a report as indented JSON.
pub fn write_json(path: &Path, report: &impl Serialize) -> anyhow::Result<()> {
    let mut text =
        serde_json::to_string_pretty(report).context("cannot write the report as JSON")?;
    text.push('\n');
    write_atomic(path, &text)
}

/// Writes a file atomically: `path` never refers to an incomplete file.
pub fn write_atomic(path: &Path, text: &str) -> anyhow::Result<()> {
    files::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

/// Writes the list of keyframes and their splits that `--keyframes` accepts.
pub fn write_keyframe_list(path: &Path, keyframes: &[Arc<Keyframe>]) -> anyhow::Result<()> {
    write_atomic(path, &keyframe::list_text(keyframes.iter()))
}

/// SHA-256 over the model files of a folder, each preceded by its name and length.
pub fn checkpoint_sha256(folder: &Path) -> anyhow::Result<String> {
    let mut hash = Sha256::new();
    let mut n_files = 0;
    for name in ModelKind::model_files() {
        let path = folder.join(name);
        if !path.exists() {
            continue;
        }
        let bytes = files::read(&path, files::Budget::PLAIN)
            .with_context(|| format!("cannot read {}", path.display()))?;
        // Because of names and lengths, different files cannot give the same sequence of bytes.
        hash.update(format!("{name} {}\n", bytes.len()));
        hash.update(&bytes);
        n_files += 1;
    }
    ensure!(n_files > 0, "{} contains no model", folder.display());
    Ok(hex(&hash.finalize()))
}

/// Lower-case hexadecimal digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Formats a UTC time since 1970 as `20261121-093000`.
fn name_from_time(since_epoch: Duration) -> String {
    let secs = since_epoch.as_secs();
    let (year, month, day) = date_from_days(secs / SECS_PER_DAY);
    let secs_of_day = secs % SECS_PER_DAY;
    format!(
        "{year:04}{month:02}{day:02}-{:02}{:02}{:02}",
        secs_of_day / 3600,
        secs_of_day / 60 % 60,
        secs_of_day % 60
    )
}

/// Date and time of day in UTC, for readers.
pub fn utc_now() -> String {
    #[expect(clippy::disallowed_methods, reason = "only shown; no time is measured")]
    let since_epoch = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    format!("{} UTC", utc_time(since_epoch))
}

/// Date and time of day in UTC of a time since 1970, such as `2026-11-21 09:30`.
#[must_use]
pub fn utc_time(since_epoch: Duration) -> String {
    let secs = since_epoch.as_secs();
    let (year, month, day) = date_from_days(secs / SECS_PER_DAY);
    let minutes = secs % SECS_PER_DAY / 60;
    format!(
        "{year:04}-{month:02}-{day:02} {:02}:{:02}",
        minutes / 60,
        minutes % 60
    )
}

/// Converts days since 1 January 1970 to year, month and day.
fn date_from_days(mut days: u64) -> (u64, usize, u64) {
    let is_leap = |year: u64| {
        year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400))
    };
    let mut year = 1970;
    while days >= 365 + u64::from(is_leap(year)) {
        days -= 365 + u64::from(is_leap(year));
        year += 1;
    }
    // Lengths of January, February and so on.
    let lengths = [
        31,
        28 + u64::from(is_leap(year)),
        31,
        30,
        31,
        30,
        31,
        31,
        30,
        31,
        30,
        31,
    ];
    let mut month_ix = 0;
    while days >= lengths[month_ix] {
        days -= lengths[month_ix];
        month_ix += 1;
    }
    (year, month_ix + 1, days + 1)
}

/// Whether a path has the file extension of recordings.
pub fn is_recording(path: &Path) -> bool {
    path.extension()
        .is_some_and(|extension| extension == RECORDING_EXTENSION)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tsdf_and_splat() -> [ModelKind; 2] {
        ["tsdf", "splat"].map(|name| ModelKind::from_name(name).expect("registered"))
    }

    #[test]
    fn folders_are_named_by_utc() {
        assert_eq!(name_from_time(Duration::ZERO), "19700101-000000");
        assert_eq!(
            name_from_time(Duration::from_secs(951_782_400)),
            "20000229-000000"
        );
        assert_eq!(
            name_from_time(Duration::from_secs(1_795_253_400)),
            "20261121-093000"
        );
        assert_eq!(
            name_from_time(Duration::from_secs(4_102_444_799)),
            "20991231-235959"
        );
    }

    #[test]
    fn folder_with_a_model_is_rejected() {
        let folder = tempfile::tempdir().expect("folder");
        assert_eq!(
            make(Some(folder.path())).expect("an empty folder"),
            folder.path()
        );
        std::fs::write(folder.path().join("model.json"), b"{}").expect("file");
        let message = make(Some(folder.path())).expect_err("a model").to_string();
        assert!(
            message.contains(folder.path().to_str().expect("plain"))
                && message.contains("model.json"),
            "{message}"
        );
    }

    #[test]
    fn models_of_several_methods_are_found_in_subfolders() {
        let folder = tempfile::tempdir().expect("folder");
        let requested = folder.path().join("out");
        let created = CreatedFolders::default()
            .make_each(Some(&requested), &tsdf_and_splat(), None)
            .expect("it is free");
        assert_eq!(created, [requested.join("tsdf"), requested.join("splat")]);
        expect_one_model(&requested).expect("there is none yet");
        std::fs::write(created[0].join(CHECKPOINT), b"{}").expect("file");
        assert!(
            models_at(&requested).is_err(),
            "a checkpoint is not a model"
        );
        std::fs::write(created[1].join("splats.ply"), b"{}").expect("file");
        assert_eq!(
            models_at(&requested).expect("one of them"),
            [requested.join("splat")]
        );
        std::fs::write(created[0].join("model.json"), b"{}").expect("file");
        assert_eq!(
            models_at(&requested).expect("both"),
            [requested.join("splat"), requested.join("tsdf")]
        );
        assert_eq!(
            models_at(&created[0]).expect("itself"),
            [requested.join("tsdf")]
        );
        std::fs::remove_file(created[0].join("model.json")).expect("file");
        let message = expect_one_model(&requested).expect_err("two").to_string();
        assert!(
            message.contains("out/splat or ") && message.ends_with("out/tsdf"),
            "{message}"
        );
        expect_one_model(&created[1]).expect("one");
        let message = check_no_model(&requested)
            .expect_err("one inside")
            .to_string();
        assert!(message.contains("splat/splats.ply"), "{message}");
    }

    #[test]
    fn unfinished_run_is_not_overwritten() {
        let out = tempfile::tempdir().expect("a folder");
        let command = ResumeCommand::of_data(Path::new("my data"));
        let check = |folder: &Path| check_no_unfinished_run(folder, &command);
        check(&out.path().join("new")).expect("nothing is there");
        let run = out.path().join(ModelKind::default().name());
        std::fs::create_dir(&run).expect("disk space");
        check(out.path()).expect("no checkpoint");
        std::fs::write(run.join(CHECKPOINT), b"x").expect("disk space");
        let message = check(out.path()).expect_err("a checkpoint").to_string();
        assert!(
            message.contains("splat contains an interrupted run")
                && message.contains(&format!("`{}`", command.line(&run))),
            "{message}"
        );
        assert!(check(&run).is_err());
    }

    #[test]
    fn rejected_run_removes_only_its_own_folders() {
        let folder = tempfile::tempdir().expect("folder");
        let (own_folder, foreign_folder) =
            (folder.path().join("a/b"), folder.path().join("theirs"));
        std::fs::create_dir(&foreign_folder).expect("disk space");
        for (requested, is_left) in [(&own_folder, false), (&foreign_folder, true)] {
            let mut created = CreatedFolders::default();
            created
                .make_each(Some(requested), &tsdf_and_splat(), None)
                .expect("it is free");
            created.keep_unless(true);
            assert_eq!(
                (requested.exists(), requested.join("tsdf").exists()),
                (is_left, false),
                "{requested:?}"
            );
        }
        assert!(!folder.path().join("a").exists());
        for (is_rejected, file) in [
            (true, CHECKPOINT),
            (true, "scan.mcap"),
            (false, "keyframes.txt"),
        ] {
            let mut created = CreatedFolders::default();
            let out = folder.path().join(file);
            created.make(Some(&out)).expect("it is free");
            std::fs::write(out.join(file), b"x").expect("file");
            created.keep_unless(is_rejected);
            assert!(out.exists(), "{file}");
        }
    }

    #[test]
    fn missing_model_error_suggests_a_path() {
        let folder = tempfile::tempdir().expect("folder");
        let at = |name: &str| folder.path().join(name);
        let message = |name: &str| expect_model(&at(name)).expect_err("no model").to_string();
        assert!(message("absent").ends_with("absent does not exist"));
        assert!(message("").ends_with("contains no model"));
        for name in [CHECKPOINT, "report.json", "scan.mcap", "mesh.ply"] {
            std::fs::write(at(name), b"x").expect("file");
            assert!(message(name).contains("give its folder"), "{name}");
            if name == CHECKPOINT {
                let resume = |command: ResumeCommand| format!("`{}`", command.line(&at("")));
                let of_data = resume(ResumeCommand::of_data(Path::new("DATA")));
                assert!(message("").contains(&of_data), "{}", message(""));
                std::fs::create_dir(at(KEYFRAMES)).expect("folder");
                let of_devices = resume(ResumeCommand::of_devices(&at(RIG_FILE)));
                assert!(message("").contains(&of_devices), "{}", message(""));
                std::fs::remove_dir(at(KEYFRAMES)).expect("folder");
            }
        }
        std::fs::write(at("splats.ply"), b"x").expect("file");
        expect_model(&at("splats.ply")).expect("a file of splats");
        expect_model(folder.path()).expect("a folder with splats");
    }

    #[test]
    fn folder_is_locked_by_one_run() {
        let folder = tempfile::tempdir().expect("folder");
        make(Some(folder.path())).expect("the first");
        let message = make(Some(folder.path()))
            .expect_err("the second")
            .to_string();
        assert!(
            message.contains("another run uses this folder"),
            "{message}"
        );
    }

    #[test]
    fn checksum_covers_model_files_only() {
        let folder = tempfile::tempdir().expect("folder");
        assert!(
            checkpoint_sha256(folder.path()).is_err(),
            "no model, no checksum"
        );
        std::fs::write(folder.path().join("splats.ply"), b"abc").expect("file");
        let first = checkpoint_sha256(folder.path()).expect("a model");
        std::fs::write(folder.path().join("report.json"), b"other").expect("file");
        assert_eq!(checkpoint_sha256(folder.path()).expect("a model"), first);
        std::fs::write(folder.path().join("splats.ply"), b"abd").expect("file");
        assert_ne!(checkpoint_sha256(folder.path()).expect("a model"), first);
    }
}
