//! Opens the page in a window of an installed Chromium-based browser, without address bar and tabs.

use anyhow::Context;
use messages::BadInput;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// A Chromium-based browser.
struct Browser {
    /// Names of its program, most common first.
    programs: &'static [&'static str],
    /// Its identifier as a flatpak, which is also the name of the program that flatpak installs.
    flatpak: &'static str,
}

/// In the order in which they are preferred.
const BROWSERS: [Browser; 4] = [
    Browser {
        programs: &["chromium", "chromium-browser"],
        flatpak: "org.chromium.Chromium",
    },
    Browser {
        programs: &["google-chrome", "google-chrome-stable"],
        flatpak: "com.google.Chrome",
    },
    Browser {
        programs: &["microsoft-edge", "microsoft-edge-stable"],
        flatpak: "com.microsoft.Edge",
    },
    Browser {
        programs: &["brave-browser", "brave"],
        flatpak: "com.brave.Browser",
    },
];
/// Where flatpak installs programs: for all users, and below the home folder for one user.
const FLATPAK_OF_ALL: &str = "/var/lib/flatpak/exports/bin";
const FLATPAK_OF_USER: &str = ".local/share/flatpak/exports/bin";
/// Scripts of distributions that start a snap are shorter than this, bytes.
const MAX_SCRIPT_BYTES: u64 = 4096;

/// How a browser is installed. Snaps and flatpaks can write only to some folders.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Packaging {
    Ordinary,
    /// A snap of this name.
    Snap(String),
    /// A flatpak with this identifier.
    Flatpak(String),
}

/// A browser that can open a window.
#[derive(Clone, Debug)]
pub(crate) struct AppWindow {
    program: PathBuf,
    profile: PathBuf,
    is_root: bool,
}

impl AppWindow {
    /// Finds a browser. `data` is the user's folder for data of this program.
    pub(crate) fn find(data: &Path) -> Result<Self, BadInput> {
        if !has_display() {
            return Err(BadInput(
                "--app needs a desktop, but neither WAYLAND_DISPLAY nor DISPLAY is set: run the command in a desktop \
                 session, or leave out --app and open the printed address in a browser"
                    .to_owned(),
            ));
        }
        let home = std::env::home_dir();
        let path = std::env::var_os("PATH").unwrap_or_default();
        let folders: Vec<PathBuf> = std::env::split_paths(&path).collect();
        let Some((program, packaging)) = find_browser(&folders, home.as_deref()) else {
            return Err(BadInput(
                "--app needs a Chromium-based browser, but found neither Chromium, Google Chrome, Microsoft Edge nor \
                 Brave: install one of them, or leave out --app and open the printed address in another browser"
                    .to_owned(),
            ));
        };
        let profile = profile_folder(&packaging, data, home.as_deref());
        Ok(Self {
            program,
            profile,
            is_root: is_root(),
        })
    }

    /// Opens a window with this address. The window and the run end independently of each other.
    pub(crate) fn open(&self, url: &str) -> anyhow::Result<()> {
        std::fs::create_dir_all(&self.profile)
            .with_context(|| format!("cannot create the browser profile {:?}", self.profile))?;
        if self.is_root {
            log::warn!(
                "Chromium runs as root only without its sandbox, so the window is opened without it; run fieldrig as another \
                 user to keep the sandbox"
            );
        }
        let mut command = Command::new(&self.program);
        command
            .args(self.arguments(url))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        // The program itself sets this value if there is no Wayland session; see main.rs.
        if std::env::var_os("WAYLAND_DISPLAY").is_some_and(|name| name == "/nowhere") {
            command.env_remove("WAYLAND_DISPLAY");
        }
        // Ctrl-C in the terminal ends the run, and the window then shows the result.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut browser = command
            .spawn()
            .with_context(|| format!("cannot start the browser {:?}", self.program))?;
        let program = self.program.clone();
        std::thread::Builder::new()
            .name("app-window".to_owned())
            .spawn(move || match browser.wait() {
                Ok(status) if !status.success() => log::warn!(
                    "the window of the page closed: {} ended with {status}; open the printed address in a browser",
                    program.display()
                ),
                _ => log::info!("the window of the page was closed; the page is still served"),
            })
            .context("cannot start the thread that waits for the browser")?;
        Ok(())
    }

    fn arguments(&self, url: &str) -> Vec<String> {
        let mut switches = vec![
            format!("app={url}"),
            format!("user-data-dir={}", self.profile.display()),
            "no-first-run".to_owned(),
            "no-default-browser-check".to_owned(),
        ];
        if self.is_root {
            switches.push("no-sandbox".to_owned());
        }
        let flag = |switch: String| format!("--{switch}");
        switches.into_iter().map(flag).collect()
    }
}

/// Whether windows can be opened. Systems without X11 and Wayland always have a desktop.
fn has_display() -> bool {
    let is_set = |name: &str| {
        std::env::var_os(name).is_some_and(|value| !value.is_empty() && value != "/nowhere")
    };
    !cfg!(target_os = "linux") || is_set("WAYLAND_DISPLAY") || is_set("DISPLAY")
}

/// Whether this process runs as root: its entry in `/proc` belongs to its user.
#[cfg(unix)]
fn is_root() -> bool {
    std::fs::metadata("/proc/self")
        .is_ok_and(|process| std::os::unix::fs::MetadataExt::uid(&process) == 0)
}

#[cfg(not(unix))]
fn is_root() -> bool {
    false
}

/// The first installed browser. `folders` are those of the search path.
fn find_browser(folders: &[PathBuf], home: Option<&Path>) -> Option<(PathBuf, Packaging)> {
    let programs = BROWSERS.iter().flat_map(|browser| browser.programs);
    let mut ordinary =
        programs.flat_map(|name| folders.iter().map(move |folder| folder.join(name)));
    if let Some(program) = ordinary.find(|path| is_program(path)) {
        let packaging = snap_of(&program).map_or(Packaging::Ordinary, Packaging::Snap);
        return Some((program, packaging));
    }
    let flatpak_folders = [
        home.map(|home| home.join(FLATPAK_OF_USER)),
        Some(PathBuf::from(FLATPAK_OF_ALL)),
    ];
    BROWSERS.iter().find_map(|browser| {
        flatpak_folders
            .iter()
            .flatten()
            .chain(folders)
            .map(|folder| folder.join(browser.flatpak))
            .find(|path| is_program(path))
            .map(|path| (path, Packaging::Flatpak(browser.flatpak.to_owned())))
    })
}

#[cfg(unix)]
fn is_program(path: &Path) -> bool {
    const ANY_EXECUTE: u32 = 0o111;
    std::fs::metadata(path).is_ok_and(|file| {
        file.is_file()
            && std::os::unix::fs::PermissionsExt::mode(&file.permissions()) & ANY_EXECUTE != 0
    })
}

#[cfg(not(unix))]
fn is_program(path: &Path) -> bool {
    path.is_file()
}

/// The name of the snap that a program starts. Ubuntu's `/usr/bin/chromium-browser` is a script that
/// starts `/snap/bin/chromium`.
fn snap_of(program: &Path) -> Option<String> {
    const SNAPS: &str = "/snap/bin/";
    if let Ok(name) = program.strip_prefix(SNAPS) {
        return Some(name.to_string_lossy().into_owned());
    }
    let script = std::fs::File::open(program).ok()?;
    let mut text = Vec::new();
    script.take(MAX_SCRIPT_BYTES).read_to_end(&mut text).ok()?;
    if !text.starts_with(b"#!") {
        return None;
    }
    let text = String::from_utf8_lossy(&text);
    let (_, rest) = text.split_once(SNAPS)?;
    let is_in_name = |letter: char| letter.is_ascii_alphanumeric() || letter == '-';
    let name: String = rest
        .chars()
        .take_while(|letter| is_in_name(*letter))
        .collect();
    (!name.is_empty()).then_some(name)
}

/// A folder for the profile to which the browser can write. Snaps see no hidden folders of the home
/// folder, and flatpaks only their own folder.
fn profile_folder(packaging: &Packaging, data: &Path, home: Option<&Path>) -> PathBuf {
    match (packaging, home) {
        (Packaging::Snap(name), Some(home)) => {
            home.join("snap").join(name).join("common/fieldrig-window")
        }
        (Packaging::Flatpak(id), Some(home)) => {
            home.join(".var/app").join(id).join("data/fieldrig-window")
        }
        _ => data.join("window"),
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    /// Writes a file that can be run.
    fn install(folder: &Path, name: &str, text: &str) -> PathBuf {
        std::fs::create_dir_all(folder).expect("a folder");
        let path = folder.join(name);
        std::fs::write(&path, text).expect("written");
        let permissions = std::fs::Permissions::from_mode(0o755);
        std::fs::set_permissions(&path, permissions).expect("set");
        path
    }

    #[test]
    fn browsers_are_found_in_the_order_of_preference() {
        let folder = tempfile::tempdir().expect("a folder");
        let [first, second, home] = ["a", "b", "home"].map(|name| folder.path().join(name));
        let path = [first.clone(), second.clone()];
        // The flatpaks of all users may exist on the computer that runs the test.
        let flatpak = install(
            &home.join(FLATPAK_OF_USER),
            "org.chromium.Chromium",
            "#!/bin/sh\n",
        );
        let found = find_browser(&path, Some(&home));
        let packaging = Packaging::Flatpak("org.chromium.Chromium".to_owned());
        assert_eq!(found, Some((flatpak, packaging)));

        // A file that cannot be run is no browser.
        std::fs::create_dir_all(&second).expect("a folder");
        std::fs::write(second.join("chromium"), "").expect("written");
        let brave = install(&first, "brave", "ELF");
        assert_eq!(
            find_browser(&path, Some(&home)),
            Some((brave, Packaging::Ordinary))
        );
        let edge = install(&second, "microsoft-edge", "ELF");
        assert_eq!(
            find_browser(&path, Some(&home)),
            Some((edge, Packaging::Ordinary))
        );
        let script = "#!/bin/sh\nexec /snap/bin/chromium \"$@\"\n";
        let chromium = install(&second, "chromium-browser", script);
        assert_eq!(
            find_browser(&path, Some(&home)),
            Some((chromium, Packaging::Snap("chromium".to_owned())))
        );
    }

    #[test]
    fn the_profile_is_where_the_browser_can_write() {
        let [data, home] = ["/home/ann/.local/share/fieldrig", "/home/ann"].map(Path::new);
        let folder = |packaging: &Packaging| profile_folder(packaging, data, Some(home));
        assert_eq!(folder(&Packaging::Ordinary), data.join("window"));
        assert_eq!(
            folder(&Packaging::Snap("chromium".to_owned())),
            home.join("snap/chromium/common/fieldrig-window")
        );
        assert_eq!(
            folder(&Packaging::Flatpak("com.google.Chrome".to_owned())),
            home.join(".var/app/com.google.Chrome/data/fieldrig-window")
        );
        assert_eq!(
            snap_of(Path::new("/snap/bin/brave")),
            Some("brave".to_owned())
        );
    }

    #[test]
    fn only_root_has_no_sandbox() {
        let arguments = |is_root| {
            let window = AppWindow {
                program: "/usr/bin/chromium".into(),
                profile: "/tmp/profile".into(),
                is_root,
            };
            window
                .arguments("https://192.168.1.20:7007/#token=0f3c")
                .join(" ")
        };
        let of_user = "--app=https://192.168.1.20:7007/#token=0f3c --user-data-dir=/tmp/profile --no-first-run \
                       --no-default-browser-check";
        assert_eq!(arguments(false), of_user);
        assert_eq!(arguments(true), format!("{of_user} --no-sandbox"));
    }
}
