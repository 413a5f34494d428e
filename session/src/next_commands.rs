//! Suggested commands to run after training. They work as printed in the folder where training was
//! started.

use messages::{Setting, quoted_for_shell};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use trainer::ModelKind;
use trainer::method_entry::Export;

/// The images that a model was trained on, for commands that need them.
#[derive(Clone, Debug, Default)]
pub struct DataSource {
    /// Dataset folder or recording; `None` if a live run was not recorded.
    pub path: Option<PathBuf>,
    /// Flags that make `eval` load the same images.
    pub flags: Vec<String>,
    /// Names of the images, by camera and stamp.
    pub image_names: BTreeMap<(String, i64), String>,
}

impl DataSource {
    /// The file name of an image, or its camera and stamp if no file name is known.
    pub fn image_name(&self, camera: &str, stamp_nanos: i64) -> String {
        let known = self.image_names.get(&(camera.to_owned(), stamp_nanos));
        known
            .cloned()
            .unwrap_or_else(|| format!("{camera}/{stamp_nanos}"))
    }
}

/// Properties of a saved model that its commands depend on.
#[derive(Clone, Copy, Debug)]
pub struct SavedModel<'a> {
    /// The method.
    pub kind: ModelKind,
    /// Folder of the model.
    pub folder: &'a Path,
    /// The images that the model was trained on.
    pub data: &'a DataSource,
    /// Number of test images.
    pub n_tests: usize,
}

/// A command and its purpose.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NextCommand {
    /// What the command is for.
    pub purpose: String,
    /// The command line.
    pub command: String,
}

/// The commands for models that were trained together.
pub fn for_models(models: &[SavedModel<'_>]) -> Vec<NextCommand> {
    let mut commands = Vec::new();
    let mut add = |purpose: &str, words: &[&str]| {
        commands.push(NextCommand {
            purpose: purpose.to_owned(),
            command: command_line(words.iter().copied().map(str::to_owned)),
        });
    };
    if let Some(folder) = common_folder(models) {
        add("view the model", &["view", &argument(folder)]);
    }
    for model in models {
        let folder = argument(model.folder);
        // A live run that was not recorded has no data to score with.
        if let (Some(data), 1..) = (&model.data.path, model.n_tests) {
            // The list has the splits of this run, so that the same images are test images.
            let list = argument(&model.folder.join("keyframes.txt"));
            let mut words = vec!["eval", &*folder];
            let data = argument(data);
            let keyframes = Setting::Keyframes.to_string();
            words.extend([&*data, &keyframes, &list]);
            words.extend(model.data.flags.iter().map(String::as_str));
            add("score the model again", &words);
        }
        if let Some(Export {
            format, contents, ..
        }) = model.kind.entry().exports.first()
        {
            let file = argument(&unused_file(&model_name(model.folder), format));
            let [to, out] = [Setting::To, Setting::Out].map(|setting| setting.to_string());
            add(
                &format!("export the {contents}"),
                &["export", &folder, &to, format, &out, &file],
            );
        }
    }
    commands
}

/// A command line of this program, as it was called, with the words quoted for a shell.
pub(crate) fn command_line(words: impl IntoIterator<Item = String>) -> String {
    let program = std::env::args_os()
        .next()
        .map_or("fieldrig".into(), |word| {
            word.to_string_lossy().into_owned()
        });
    let words: Vec<String> = std::iter::once(program)
        .chain(words)
        .map(|word| quoted_for_shell(&word))
        .collect();
    words.join(" ")
}

/// The command line of this process.
pub fn this_command() -> String {
    std::env::args_os()
        .map(|word| quoted_for_shell(&word.to_string_lossy()))
        .collect::<Vec<_>>()
        .join(" ")
}

/// Purposes and commands in two columns.
pub fn lines(commands: &[NextCommand]) -> Vec<String> {
    let width = commands
        .iter()
        .map(|next| next.purpose.len())
        .max()
        .unwrap_or_default()
        + 1;
    let line =
        |next: &NextCommand| format!("{:width$}  {}", format!("{}:", next.purpose), next.command);
    commands.iter().map(line).collect()
}

/// The folder to view: the folder of a single model, or the parent folder of several models.
fn common_folder<'a>(models: &[SavedModel<'a>]) -> Option<&'a Path> {
    match models {
        [] => None,
        [model] => Some(model.folder),
        [model, ..] => model.folder.parent(),
    }
}

/// Base name for exported files: the name of the model's folder. In a run of several methods, that
/// is the method name.
fn model_name(folder: &Path) -> String {
    folder.file_name().map_or_else(
        || "model".to_owned(),
        |name| name.to_string_lossy().into_owned(),
    )
}

/// An unused file name in the current folder; `export` does not overwrite files.
fn unused_file(name: &str, extension: &str) -> PathBuf {
    // If all of these exist, the last name is suggested, and `export` reports the problem.
    (1..100)
        .map(|n| numbered_file(name, n, extension))
        .find(|file| !file.exists())
        .unwrap_or_else(|| numbered_file(name, 100, extension))
}

/// File name with a number; the first one has none.
fn numbered_file(name: &str, n: u32, extension: &str) -> PathBuf {
    PathBuf::from(if n == 1 {
        format!("{name}.{extension}")
    } else {
        format!("{name}-{n}.{extension}")
    })
}

/// A path as a positional argument. A path that starts with a hyphen would be parsed as a flag, so
/// `./` is prepended.
pub(crate) fn argument(path: &Path) -> String {
    let text = path.to_string_lossy();
    if text.starts_with('-') {
        format!("./{text}")
    } else {
        text.into_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_depend_on_the_kind_of_model() {
        let data = DataSource {
            path: Some("my data".into()),
            flags: vec!["scale".into(), "0.5".into()],
            ..DataSource::default()
        };
        let kind = |name| ModelKind::from_name(name).expect("registered");
        let model = |name, folder| SavedModel {
            kind: kind(name),
            folder: Path::new(folder),
            data: &data,
            n_tests: 3,
        };
        let commands = |models: &[SavedModel<'_>]| -> Vec<String> {
            let program = quoted_for_shell(&std::env::args().next().expect("a program"));
            let strip = |next: NextCommand| {
                next.command
                    .trim_start_matches(&format!("{program} "))
                    .to_owned()
            };
            for_models(models).into_iter().map(strip).collect()
        };
        assert_eq!(
            commands(&[model("splat", "runs/a b")]),
            [
                "view 'runs/a b'",
                "eval 'runs/a b' 'my data' keyframes 'runs/a b/keyframes.txt' scale 0.5",
                "export 'runs/a b' format spz out 'a b.spz'",
            ]
        );
        assert_eq!(
            commands(&[model("nerf", "both/nerf"), model("tsdf", "both/tsdf")]),
            [
                "view both",
                "eval both/nerf 'my data' keyframes both/nerf/keyframes.txt scale 0.5",
                "eval both/tsdf 'my data' keyframes both/tsdf/keyframes.txt scale 0.5",
                "export both/tsdf format glb out tsdf.glb",
            ]
        );
        let live = DataSource::default();
        let unscored = SavedModel {
            data: &live,
            ..model("nerf", "-out")
        };
        assert_eq!(commands(&[unscored]), ["view ./-out"]);
        assert_eq!(commands(&[]), Vec::<String>::new());
    }

    #[test]
    fn unnamed_images_use_camera_and_stamp() {
        let mut data = DataSource::default();
        data.image_names
            .insert(("camera".into(), 8), "images/0008.jpg".into());
        assert_eq!(data.image_name("camera", 8), "images/0008.jpg");
        assert_eq!(data.image_name("camera", 9), "camera/9");
    }
}
