//! Tests `--app`: the command line of the browser, the reasons why no window can be opened, and a real
//! window of Chromium on a virtual display.

use crate::command::stderr;
use serde_json::Value;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Much longer than a browser needs on two busy cores.
const TIMEOUT: Duration = Duration::from_secs(240);
/// Size of the virtual display, pixels.
const SCREEN_PX: [usize; 2] = [1024, 768];
/// The color of the page's panels, red, green and blue.
const PANEL_COLOR: [u8; 3] = [0x11, 0x16, 0x1d];

/// Writes a program.
fn install(folder: &Path, name: &str, text: &str) {
    std::fs::create_dir_all(folder).expect("a folder");
    let path = folder.join(name);
    std::fs::write(&path, text).expect("written");
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).expect("set");
}

/// Writes a splat file with two splats: position, scale, color and rotation of each (32 bytes).
fn write_model(folder: &Path) {
    let splat = |x_m: f32| -> Vec<u8> {
        let numbers = [x_m, 0.0, 0.0, 0.1, 0.1, 0.1];
        let bytes = numbers.iter().flat_map(|number| number.to_le_bytes());
        bytes
            .chain([200, 100, 50, 255, 255, 128, 128, 128])
            .collect()
    };
    std::fs::write(folder.join("scan.splat"), [splat(0.0), splat(0.5)].concat()).expect("written");
}

/// `fieldrig view --app`, with programs from these folders only.
fn command(folder: &Path, path: &[&Path], display: Option<&str>) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command
        .args([
            "view",
            "scan.splat",
            "--app",
            "--json",
            "--listen",
            "127.0.0.1:0",
        ])
        .current_dir(folder)
        .env("PATH", std::env::join_paths(path).expect("no colons"))
        .env("HOME", folder)
        .env("XDG_DATA_HOME", folder.join("data"))
        .env_remove("WAYLAND_DISPLAY")
        .env_remove("DISPLAY");
    if let Some(display) = display {
        command.env("DISPLAY", display);
    }
    command
}

/// A running `fieldrig view --app`.
struct View {
    process: Child,
    url: String,
}

impl View {
    fn start(mut command: Command) -> Self {
        let mut process = command
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("fieldrig starts");
        let stdout = process.stdout.take().expect("piped");
        let line = BufReader::new(stdout).lines().next();
        let line = line
            .expect("a line before the end")
            .expect("stdout is read");
        let serving: Value = serde_json::from_str(&line).expect("a JSON object");
        let url = serving["url"].as_str().expect("an address").to_owned();
        Self { process, url }
    }

    /// The status of the page. Fails if the program no longer serves it.
    fn status(&self) -> Value {
        let host = self.url.trim_start_matches("http://").trim_end_matches('/');
        let mut stream = TcpStream::connect(host).expect("the page is served");
        let request = format!("GET /status HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).expect("sent");
        let mut response = String::new();
        stream.read_to_string(&mut response).expect("an answer");
        let (_, body) = response.split_once("\r\n\r\n").expect("a head");
        serde_json::from_str(body).expect("JSON")
    }

    fn n_clients(&self) -> usize {
        self.status()["clients"].as_array().map_or(0, Vec::len)
    }

    /// Ends the program as Ctrl-C does, and returns its messages.
    fn interrupt(mut self) -> Output {
        let kill = format!("kill -INT {}", self.process.id());
        let status = Command::new("sh").args(["-c", &kill]).status();
        assert!(status.expect("sh starts").success());
        let mut text = Vec::new();
        let mut messages = self.process.stderr.take().expect("piped");
        messages.read_to_end(&mut text).expect("stderr is read");
        Output {
            status: self.process.wait().expect("it ends"),
            stdout: Vec::new(),
            stderr: text,
        }
    }
}

impl Drop for View {
    fn drop(&mut self) {
        let _ = self.process.kill(); // Fails if the process has already ended.
    }
}

fn wait_for(what: &str, mut is_there: impl FnMut() -> bool) {
    let started = Instant::now();
    while !is_there() {
        assert!(started.elapsed() < TIMEOUT, "timed out waiting for {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn the_window_has_the_address_and_its_own_profile_and_the_page_outlives_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write_model(folder);
    let programs = folder.join("bin");
    // This browser writes its command line to a file and ends, as when its window is closed.
    let script = format!(
        "#!/bin/sh\nprintf '%s\\n' \"$@\" > {0}/arguments.part\n/bin/mv {0}/arguments.part {0}/arguments\n",
        folder.display()
    );
    install(&programs, "google-chrome", &script);
    let view = View::start(command(folder, &[&programs], Some(":99")));
    let written = folder.join("arguments");
    wait_for("the browser", || written.is_file());
    let arguments = std::fs::read_to_string(written).expect("written");
    let profile = folder.join("data/fieldrig/window");
    let lines: Vec<&str> = arguments.lines().collect();
    assert_eq!(lines[0], format!("--app={}", view.url));
    assert_eq!(lines[1], format!("--user-data-dir={}", profile.display()));
    assert!(profile.is_dir(), "the profile has a folder");
    let is_root = std::fs::metadata("/proc/self")
        .is_ok_and(|process| std::os::unix::fs::MetadataExt::uid(&process) == 0);
    assert_eq!(lines.contains(&"--no-sandbox"), is_root, "{arguments}");
    assert_eq!(view.status()["state"], "viewing");
    let output = view.interrupt();
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(
        stderr(&output).contains("without its sandbox"),
        is_root,
        "{}",
        stderr(&output)
    );
}

#[test]
fn without_a_browser_or_a_desktop_there_is_one_sentence() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write_model(folder);
    let programs = folder.join("bin");
    std::fs::create_dir(&programs).expect("a folder");
    for (display, sentence) in [
        (
            None,
            "--app needs a desktop, but neither WAYLAND_DISPLAY nor DISPLAY is set",
        ),
        (
            Some(":99"),
            "--app needs a Chromium-based browser, but found neither Chromium",
        ),
    ] {
        let output = command(folder, &[&programs], display)
            .output()
            .expect("it runs");
        assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
        let message = stderr(&output);
        assert!(message.contains(sentence), "{message}");
        assert_eq!(message.trim().lines().count(), 1, "{message}");
        assert!(output.stdout.is_empty(), "nothing is served");
    }
}

/// A virtual display.
struct Display {
    process: Child,
    name: String,
    /// Folder with the pixels.
    pixels: PathBuf,
}

impl Display {
    /// `None` if the program is not installed.
    fn start(folder: &Path) -> Option<Self> {
        let [width, height] = SCREEN_PX;
        let mut process = Command::new("Xvfb")
            .args(["-displayfd", "1", "-nolisten", "tcp", "-screen", "0"])
            .arg(format!("{width}x{height}x24"))
            .arg("-fbdir")
            .arg(folder)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .ok()?;
        let stdout = process.stdout.take().expect("piped");
        let number = BufReader::new(stdout)
            .lines()
            .next()
            .expect("a line")
            .expect("read");
        Some(Self {
            process,
            name: format!(":{number}"),
            pixels: folder.join("Xvfb_screen0"),
        })
    }

    /// Number of pixels of this color.
    fn count(&self, [red, green, blue]: [u8; 3]) -> usize {
        let [width, height] = SCREEN_PX;
        let file = std::fs::read(&self.pixels).expect("the pixels");
        // The image is at the end of the file, after a header and a table of colors. Each pixel is
        // blue, green, red and a byte without meaning.
        let n_bytes = 4 * width * height;
        let is_color = |pixel: &&[u8]| pixel[..3] == [blue, green, red];
        file[file.len() - n_bytes..]
            .chunks_exact(4)
            .filter(is_color)
            .count()
    }

    fn end(&mut self) {
        let _ = self.process.kill(); // Fails if the process has already ended.
        let _ = self.process.wait();
    }
}

impl Drop for Display {
    fn drop(&mut self) {
        self.end();
    }
}

#[test]
fn a_real_window_shows_the_page_without_bars() {
    let Some(chromium) = test_support::browser::browser_for_page() else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let Some(mut display) = Display::start(folder) else {
        test_support::skip("Xvfb is missing (apt install xvfb)");
        return;
    };
    write_model(folder);
    // Without a GPU, browsers have no WebGL unless they are asked for a renderer on the CPU.
    let programs = folder.join("bin");
    let script = format!(
        "#!/bin/sh\nexec {} --use-angle=swiftshader --enable-unsafe-swiftshader --window-position=0,0 --window-size={},{} \"$@\"\n",
        chromium.display(),
        SCREEN_PX[0],
        SCREEN_PX[1]
    );
    install(&programs, "chromium", &script);
    let system = ["/usr/bin", "/bin"].map(Path::new);
    let path = [&[programs.as_path()], &system[..]].concat();
    let view = View::start(command(folder, &path, Some(&display.name)));
    wait_for("the page in the window", || view.n_clients() == 1);
    let n_px = SCREEN_PX[0] * SCREEN_PX[1];
    // The panels beside and above the view have this color. A bar of the browser has another one.
    wait_for("the panels of the page", || {
        display.count(PANEL_COLOR) > n_px / 20
    });
    if let Some(shot) = std::env::var_os("FIELDRIG_WINDOW_SHOT") {
        std::fs::copy(&display.pixels, shot).expect("copied");
    }
    display.end();
    wait_for("the end of the window", || view.n_clients() == 0);
    assert_eq!(
        view.status()["state"],
        "viewing",
        "the page outlives its window"
    );
    let output = view.interrupt();
    assert!(output.status.success(), "{}", stderr(&output));
}
