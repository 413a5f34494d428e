//! Headless Chromium, driven over its debugging protocol.
//!
//! Starting Chromium takes about 2 s of computing time, and opening an empty page in a running one
//! half a second. Tests therefore use the browsers of earlier tests. No two tests use a browser at
//! the same time, and each test has a browser context of its own, without data of earlier pages.
//!
//! All functions panic if the browser does not answer.

use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use tungstenite::{Message, WebSocket};

/// This is far more time than a browser needs on two busy cores.
const TIMEOUT: Duration = Duration::from_secs(300);

/// A script for [`Browser::open_with`]: WebGL calls draw nothing, because drawing on the CPU takes
/// most of the time.
pub const NO_DRAWING: &str = include_str!("no_drawing.js");

/// Flags for WebGL on the CPU with Mesa's llvmpipe, which takes about half the computing time of
/// the browser's own renderer. Chromium offers it only through EGL.
const MESA: [&str; 3] = [
    "--use-gl=angle",
    "--use-angle=gl-egl",
    "--ignore-gpu-blocklist",
];
/// Flags for WebGL on the CPU with the browser's own renderer, which needs no library.
const SWIFTSHADER: [&str; 2] = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"];

/// Pages of the browser's own address bar, which a headless browser loads for each window. They take
/// three times the computing time of opening an empty page.
const NO_ADDRESS_BAR: &str =
    "--disable-features=WebUIOmniboxPopup,WebUIOmniboxAimPopup,WebUIOmniboxFullPopup";

/// A fixed piece of work of a few milliseconds: numbers as text and back, sorting, and the layout of
/// new elements. The layout of the page itself does not change.
const REFERENCE_WORK: &str = "(() => {
    performance.mark('reference work');
    const values = Array.from({ length: 2000 }, (_, ix) => Math.sin(ix));
    const sorted = JSON.parse(JSON.stringify(values)).sort((a, b) => a - b);
    const list = window.referenceList ??= document.body.appendChild(document.createElement('div'));
    list.style.cssText = 'position: fixed; width: 100px; height: 100px; visibility: hidden; contain: strict';
    const texts = sorted.slice(0, 100).map((value) => value.toFixed(3));
    list.replaceChildren(...texts.map((text) => Object.assign(document.createElement('span'), { textContent: text })));
    const isLaidOut = list.lastChild.offsetHeight > 0;
    list.replaceChildren();
    return isLaidOut;
})()";
/// Time between two of these pieces of work.
const REFERENCE_PERIOD: Duration = Duration::from_millis(200);

/// The hint at the first visit would cover a part of the view. This script makes the page believe
/// that the browser has already shown the hint. Pages without an origin have no storage.
const LATER_VISIT: &str = "try { localStorage.setItem('gestures-seen', '1'); } catch {}\n";

/// Runs a browser until standard input is closed, then removes its profile. Standard input is also
/// closed when a test program ends or is killed, so no browser survives its tests. The shell gives
/// commands in the background no standard input, so it is copied first.
const RUN_UNTIL_CLOSED: &str = r#"
profile=$(mktemp -d)
exec 3<&0
"$@" --user-data-dir="$profile" about:blank 3<&- &
browser=$!
{ cat <&3; kill $browser; } >/dev/null 2>&1 &
exec 3<&-
wait $browser
rm -rf "$profile"
"#;

/// Size of the window of a browser. Pages have their own sizes.
const BROWSER_PX: [u32; 2] = [1280, 760];

/// Browsers that no test uses. There are at most as many as tests run at the same time.
static IDLE: Mutex<Vec<Process>> = Mutex::new(Vec::new());

/// A running browser.
struct Process {
    shell: Child,
    /// The browser ends when this is closed.
    stdin: Option<ChildStdin>,
    /// Address of its debugging protocol.
    address: String,
}

/// A page in a browser, which no other test uses meanwhile.
pub struct Browser {
    process: Option<Process>,
    socket: WebSocket<TcpStream>,
    context: String,
    session: String,
    n_calls: u64,
}

/// Path of a browser for tests of the page. If Chromium or the bundled page is missing, reports the
/// calling test as skipped and returns `None`.
///
/// # Panics
/// Panics instead of skipping the test if [tests are demanded](crate::is_demanded).
pub fn browser_for_page() -> Option<PathBuf> {
    let browser = chromium().filter(|_| bundle().join("app.js").is_file());
    if browser.is_none() {
        let reason = "Chromium or the bundled page is missing (scripts/install-packages.sh browser; make web)";
        assert!(!crate::is_demanded(), "{reason}");
        crate::skip(reason);
    }
    browser
}

/// Folder of the bundled page.
pub fn bundle() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../viz/web/dist")
}

/// Path of Chromium, if it is installed.
fn chromium() -> Option<PathBuf> {
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let folders: Vec<PathBuf> = std::env::split_paths(&std::env::var_os("PATH")?).collect();
    let paths = names
        .iter()
        .flat_map(|name| folders.iter().map(move |folder| folder.join(name)));
    paths.into_iter().find(|path| path.is_file())
}

/// A task of the main thread.
#[derive(Clone, Copy, Debug)]
pub struct Task {
    /// Duration, milliseconds.
    pub millis: f64,
    /// CPU time, milliseconds, without the time for which other programs used the core.
    pub cpu_millis: f64,
}

/// Tasks of a page's main thread.
#[derive(Clone, Debug, Default)]
pub struct TracedTasks {
    /// Tasks of the page.
    pub of_page: Vec<Task>,
    /// Tasks of fixed work. They measure how fast this computer runs pages at the same time.
    pub reference: Vec<Task>,
}

impl TracedTasks {
    /// The 99th percentile of the CPU time of the page's tasks, relative to the median of the fixed
    /// work. Prints it with other figures.
    pub fn relative_p99(&self) -> f64 {
        let n_tasks = self.of_page.len();
        assert!(n_tasks > 500, "only {n_tasks} tasks");
        let sorted = |tasks: &[Task], millis: fn(&Task) -> f64| {
            let mut millis: Vec<f64> = tasks.iter().map(millis).collect();
            millis.sort_by(f64::total_cmp);
            millis
        };
        let at = |sorted: &[f64], per_mille: usize| sorted[(sorted.len() - 1) * per_mille / 1000];
        let cpu = sorted(&self.of_page, |task| task.cpu_millis);
        let wall = sorted(&self.of_page, |task| task.millis);
        let reference_millis = at(&sorted(&self.reference, |task| task.cpu_millis), 500);
        let p99 = at(&cpu, 990) / reference_millis;
        eprintln!(
            "{n_tasks} tasks, CPU time: median {:.2} ms, 99 % {:.2} ms, longest {:.2} ms; duration 99 % {:.2} ms; \
             fixed work {reference_millis:.2} ms, 99 % is {p99:.2} times as long",
            at(&cpu, 500),
            at(&cpu, 990),
            at(&cpu, 1000),
            at(&wall, 990)
        );
        p99
    }
}

impl Process {
    /// Starts a browser with these flags for WebGL.
    fn start(program: &Path, webgl: &[&str]) -> Self {
        let [width, height] = BROWSER_PX;
        let mut shell = Command::new("sh")
            .args(["-c", RUN_UNTIL_CLOSED, "sh"])
            .arg(program)
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-quic",
                "--no-first-run",
                "--ignore-certificate-errors",
            ])
            .args([
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-extensions",
                "--disable-sync",
                NO_ADDRESS_BAR,
            ])
            .args(webgl)
            .env("LIBGL_ALWAYS_SOFTWARE", "1")
            .args(["--hide-scrollbars", "--remote-debugging-port=0"])
            .arg("--force-device-scale-factor=1")
            .arg(format!("--window-size={width},{height}"))
            .stdin(Stdio::piped())
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .expect("sh starts");
        let stdin = shell.stdin.take();
        let mut lines = BufReader::new(shell.stderr.take().expect("stderr is piped")).lines();
        let address = lines
            .by_ref()
            .map_while(Result::ok)
            .find_map(|line| {
                line.strip_prefix("DevTools listening on ")
                    .map(str::to_owned)
            })
            .expect("chromium prints its debugging address");
        // The pipe is drained, because the browser would block once it is full.
        std::thread::spawn(move || lines.map_while(Result::ok).for_each(drop));
        Self {
            shell,
            stdin,
            address,
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        drop(self.stdin.take());
        let _ = self.shell.wait();
    }
}

impl Browser {
    /// Opens a page of this size in CSS pixels.
    pub fn open(program: &Path, url: &str, size_px: [u32; 2]) -> Self {
        Self::open_with(program, url, size_px, "")
    }

    /// Does the same as [`Browser::open`], and runs a script before the page's own scripts.
    pub fn open_with(program: &Path, url: &str, size_px: [u32; 2], script: &str) -> Self {
        let idle = IDLE.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut browser = match idle {
            Some(process) => Self::in_process(process),
            None => Self::start(program),
        };
        browser.resize(size_px);
        browser.call("Page.enable", json!({}));
        browser.call(
            "Page.addScriptToEvaluateOnNewDocument",
            json!({"source": format!("{LATER_VISIT}{script}")}),
        );
        browser.call("Page.navigate", json!({"url": url}));
        browser
    }

    /// Starts a browser that supports WebGL.
    fn start(program: &Path) -> Self {
        let mut browser = Self::in_process(Process::start(program, &MESA));
        let has_webgl = "document.createElement('canvas').getContext('webgl2') !== null";
        if browser.evaluate(has_webgl) != true {
            browser.end();
            browser = Self::in_process(Process::start(program, &SWIFTSHADER));
        }
        browser
    }

    /// Opens an empty page in a running browser.
    fn in_process(process: Process) -> Self {
        let host = process
            .address
            .trim_start_matches("ws://")
            .split('/')
            .next()
            .expect("a host");
        let stream = TcpStream::connect(host).expect("chromium listens");
        stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
        let (socket, _) = tungstenite::client(&process.address, stream).expect("a WebSocket");
        let mut browser = Self {
            process: Some(process),
            socket,
            context: String::new(),
            session: String::new(),
            n_calls: 0,
        };
        let text = |value: &Value| value.as_str().expect("an identifier").to_owned();
        let context = browser.call("Target.createBrowserContext", json!({}));
        browser.context = text(&context["browserContextId"]);
        let page = json!({"url": "about:blank", "browserContextId": browser.context});
        let target = browser.call("Target.createTarget", page);
        let attached = browser.call(
            "Target.attachToTarget",
            json!({"targetId": target["targetId"], "flatten": true}),
        );
        browser.session = text(&attached["sessionId"]);
        browser
    }

    /// Ends the browser, so that no other test uses it.
    fn end(&mut self) {
        self.process = None;
    }

    /// Changes the window's size in CSS pixels.
    pub fn resize(&mut self, [width, height]: [u32; 2]) {
        let size =
            json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": false});
        self.call("Emulation.setDeviceMetricsOverride", size);
    }

    /// Calls a method of the debugging protocol.
    pub fn call(&mut self, method: &str, params: Value) -> Value {
        let answer = self.answer(method, params);
        assert!(answer.get("error").is_none(), "{method}: {answer}");
        answer["result"].clone()
    }

    /// The answer to a call, which may be an error.
    fn answer(&mut self, method: &str, params: Value) -> Value {
        self.n_calls += 1;
        let mut message = json!({"id": self.n_calls, "method": method, "params": params});
        if !self.session.is_empty() {
            message["sessionId"] = json!(self.session);
        }
        self.socket
            .send(Message::text(message.to_string()))
            .expect("sent");
        loop {
            let Message::Text(text) = self.socket.read().expect("chromium answers") else {
                continue;
            };
            let answer: Value = serde_json::from_str(&text).expect("JSON");
            if answer["id"] == json!(self.n_calls) {
                return answer;
            }
        }
    }

    /// Value of a JavaScript expression. It is evaluated again if a page is loaded in the meantime.
    pub fn evaluate(&mut self, expression: &str) -> Value {
        const MAX_ATTEMPTS: u32 = 100;
        let params = json!({"expression": expression, "returnByValue": true});
        let is_replaced =
            |answer: &Value| answer["error"]["message"] == "Inspected target navigated or closed";
        let mut answer = self.answer("Runtime.evaluate", params.clone());
        for _ in 1..MAX_ATTEMPTS {
            if !is_replaced(&answer) {
                break;
            }
            std::thread::sleep(Duration::from_millis(20));
            answer = self.answer("Runtime.evaluate", params.clone());
        }
        assert!(answer.get("error").is_none(), "{expression}: {answer}");
        let result = answer["result"].clone();
        assert!(
            result.get("exceptionDetails").is_none(),
            "{expression}: {result}"
        );
        result["result"]["value"].clone()
    }

    /// Evaluates an expression that makes the browser load a page, which may end the evaluation
    /// with an error.
    pub fn load_by(&mut self, expression: &str) {
        self.answer("Runtime.evaluate", json!({"expression": expression}));
    }

    /// Waits until all events so far are on screen.
    pub fn next_frame(&mut self) {
        let frames = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))";
        self.call(
            "Runtime.evaluate",
            json!({"expression": frames, "awaitPromise": true}),
        );
    }

    /// Text of the element with this id.
    pub fn text(&mut self, id: &str) -> String {
        let text = self.evaluate(&format!(
            "document.getElementById('{id}')?.textContent ?? ''"
        ));
        text.as_str().unwrap_or_default().to_owned()
    }

    /// Clicks the element with this id.
    pub fn click(&mut self, id: &str) {
        self.evaluate(&format!("document.getElementById('{id}').click()"));
    }

    /// Moves the mouse; `kind` is `mousePressed`, `mouseMoved` or `mouseReleased`.
    pub fn mouse(&mut self, kind: &str, [x, y]: [i32; 2]) {
        let event =
            json!({"type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1});
        self.call("Input.dispatchMouseEvent", event);
    }

    /// The tasks of the page's main thread within this time, and tasks of fixed work in between.
    pub fn trace_tasks(&mut self, duration: Duration) -> TracedTasks {
        let session = std::mem::take(&mut self.session); // Tracing belongs to the browser, not to the page.
        self.call(
            "Tracing.start",
            json!({"traceConfig": {"includedCategories": ["toplevel", "blink.user_timing"]}}),
        );
        self.session = session;
        let began = Instant::now();
        while began.elapsed() < duration {
            assert_eq!(self.evaluate(REFERENCE_WORK), json!(true));
            std::thread::sleep(REFERENCE_PERIOD);
        }
        let session = std::mem::take(&mut self.session);
        self.call("Tracing.end", json!({}));
        let mut events: Vec<Value> = Vec::new();
        loop {
            let Message::Text(text) = self.socket.read().expect("chromium answers") else {
                continue;
            };
            let mut message: Value = serde_json::from_str(&text).expect("JSON");
            match message["method"].as_str() {
                Some("Tracing.dataCollected") => {
                    events.append(message["params"]["value"].as_array_mut().expect("events"));
                }
                Some("Tracing.tracingComplete") => break,
                _ => {}
            }
        }
        self.session = session;
        // Other pages, such as those of the browser itself, have threads of the same name.
        let thread = |event: &Value| [event["pid"].clone(), event["tid"].clone()];
        let is_mark = |event: &&Value| event["name"] == "reference work";
        let marks: Vec<&Value> = events.iter().filter(is_mark).collect();
        let main_thread = thread(marks.first().expect("the page has set marks"));
        let marks: Vec<f64> = marks
            .iter()
            .filter_map(|mark| mark["ts"].as_f64())
            .collect();
        let mut tasks = TracedTasks::default();
        for event in &events {
            if event["name"] != "ThreadControllerImpl::RunTask" || thread(event) != main_thread {
                continue;
            }
            let times = ["ts", "dur", "tdur"].map(|name| event[name].as_f64());
            let [Some(start), Some(duration), Some(cpu)] = times else {
                continue;
            };
            let is_reference = marks
                .iter()
                .any(|at| (start..=start + duration).contains(at));
            let list = if is_reference {
                &mut tasks.reference
            } else {
                &mut tasks.of_page
            };
            list.push(Task {
                millis: duration * 1e-3,
                cpu_millis: cpu * 1e-3,
            });
        }
        tasks
    }

    /// Screenshot of the page as PNG.
    pub fn screenshot(&mut self) -> Vec<u8> {
        let shot = self.call("Page.captureScreenshot", json!({"format": "png"}));
        bytes_from_base64(shot["data"].as_str().expect("base64"))
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // After a failure, the state of the browser is unknown.
        if std::thread::panicking() {
            self.end();
        }
        let Some(process) = self.process.take() else {
            return;
        };
        // The answer comes when the page has been closed.
        self.session.clear();
        let context = json!({"browserContextId": self.context});
        self.call("Target.disposeBrowserContext", context);
        IDLE.lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(process);
    }
}

fn bytes_from_base64(text: &str) -> Vec<u8> {
    let sextet = |symbol: u8| match symbol {
        b'A'..=b'Z' => u32::from(symbol - b'A'),
        b'a'..=b'z' => u32::from(symbol - b'a') + 26,
        b'0'..=b'9' => u32::from(symbol - b'0') + 52,
        b'+' => 62,
        _ => 63,
    };
    let symbols: Vec<u8> = text.bytes().filter(|symbol| *symbol != b'=').collect();
    symbols
        .chunks(4)
        .flat_map(|group| {
            let bits = group
                .iter()
                .fold(0, |bits, symbol| bits << 6 | sextet(*symbol))
                << (6 * (4 - group.len()));
            bits.to_be_bytes()[1..group.len()].to_vec()
        })
        .collect()
}

/// Waits until the page is in a state.
pub fn wait_for(browser: &mut Browser, what: &str, mut is_there: impl FnMut(&mut Browser) -> bool) {
    let started = Instant::now();
    while !is_there(browser) {
        if started.elapsed() >= TIMEOUT {
            let shot = std::env::temp_dir().join("fieldrig_page_timed_out.png");
            let _ = std::fs::write(&shot, browser.screenshot());
            panic!("timed out waiting for {what}; the page is shown in {shot:?}");
        }
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Left, top, width and height of the view in the window, pixels.
pub fn canvas_bounds(browser: &mut Browser) -> [u32; 4] {
    // While the page reloads, it has no elements.
    let bounds = browser.evaluate("(() => { const b = document.getElementById('canvas')?.getBoundingClientRect(); return b ? [b.x, b.y, b.width, b.height].map(Math.round) : [0, 0, 0, 0] })()");
    [0, 1, 2, 3].map(|ix| {
        bounds[ix]
            .as_u64()
            .and_then(|n| u32::try_from(n).ok())
            .expect("a bound")
    })
}

/// The part of the window that the view covers.
pub fn canvas_shot(browser: &mut Browser) -> image::RgbImage {
    browser.next_frame();
    let [x, y, width, height] = canvas_bounds(browser);
    let shot = image::load_from_memory_with_format(&browser.screenshot(), image::ImageFormat::Png)
        .expect("a PNG");
    shot.crop_imm(x, y, width, height).to_rgb8()
}
