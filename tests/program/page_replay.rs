//! Records what a run sends to the page, and replays it to a page at the original and at double
//! speed.
//!
//! WebGL calls draw nothing, because drawing on the CPU would dominate the tasks of the page.
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.
#![cfg(feature = "sim")]

use crate::page_server::PageServer;
use crate::small_rig;
use crate::wire_session::{RecordingProxy, Session};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use test_support::browser::{Browser, NO_DRAWING, browser_for_page, wait_for};

const WINDOW_PX: [u32; 2] = [1280, 720];
/// How long the run is recorded after its first picture.
const RECORDED: Duration = Duration::from_secs(15);
/// Length of the run if it is not interrupted. It is longer than the start of Chromium on a busy
/// computer and the recording take together.
const MAX_SECONDS: &str = "90";
/// Limit of the 99th percentile of the CPU time of tasks, relative to a fixed piece of work on the
/// same page ([`Browser::trace_tasks`]). CPU time does not depend on the tests that run beside
/// this one, and the ratio does not depend on the speed of the computer.
const MAX_P99: f64 = 1.2;
/// Additional time for decoding an image on a slow computer.
const SLOW_DECODING_MILLIS: u32 = 400;
/// This script is added to the page. It counts decoded images, and the decoders that run at the
/// same time.
const COUNT_DECODERS: &str = r"
window.decoders = { n: 0, nActive: 0, maxActive: 0, sizes: [], delay: 0 };
const decode = window.createImageBitmap;
window.createImageBitmap = async (blob, options) => {
  const { decoders } = window;
  decoders.n += 1;
  decoders.sizes.push(blob.size);
  decoders.nActive += 1;
  decoders.maxActive = Math.max(decoders.maxActive, decoders.nActive);
  try {
    if (decoders.delay > 0) await new Promise((done) => setTimeout(done, decoders.delay));
    return await decode(blob, options);
  } finally {
    decoders.nActive -= 1;
  }
};";

/// Opens a page without WebGL.
fn open(program: &Path, url: &str, delay_millis: u32) -> Browser {
    let script = format!("{NO_DRAWING}{COUNT_DECODERS}window.decoders.delay = {delay_millis};");
    Browser::open_with(program, url, WINDOW_PX, &script)
}

/// What the page receives while a simulated rig is trained on, and the report of the run.
fn record(program: &Path) -> (Session, Value) {
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write(folder.path(), small_rig::Pace::RealTime);
    let args = [
        "run",
        "rig.toml",
        "--sim",
        "--seconds",
        MAX_SECONDS,
        "--max-splats",
        "3000",
        "--out",
        "out",
    ];
    let mut run = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(args)
        .args(["--listen", "127.0.0.1:0", "--json"])
        .current_dir(folder.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("it is built");
    let mut lines = BufReader::new(run.stdout.take().expect("piped"))
        .lines()
        .map_while(Result::ok);
    let serving: Value = serde_json::from_str(&lines.next().expect("an event")).expect("JSON");
    let address = serving["url"]
        .as_str()
        .and_then(|url| url.strip_prefix("http://"))
        .expect("a URL");
    let proxy = RecordingProxy::start(address.trim_end_matches('/').parse().expect("an address"));
    let mut browser = open(program, &proxy.url(), 0);
    wait_for(&mut browser, "a picture", |browser| {
        browser.text("picture-text").contains(" ms")
    });
    browser.evaluate(
        "(() => { const refresh = document.getElementById('refresh'); refresh.value = 'continuous';
         refresh.dispatchEvent(new Event('change')); })()",
    );
    browser.click("toggle-keyframes");
    browser.click("toggle-points");
    std::thread::sleep(RECORDED);
    let interrupt = Command::new("kill")
        .args(["-INT", &run.id().to_string()])
        .status();
    assert!(interrupt.expect("kill runs").success());
    lines.for_each(drop);
    let status = run.wait().expect("our own child");
    assert!([Some(0), Some(3)].contains(&status.code()), "{status}"); // 3: a busy computer drops images.
    drop(browser);
    let report = std::fs::read_to_string(folder.path().join("out/report.json")).expect("a report");
    (
        proxy.session(),
        serde_json::from_str(&report).expect("JSON"),
    )
}

/// A page that receives a session.
struct Replay {
    browser: Browser,
    is_over: Arc<AtomicBool>,
}

impl Replay {
    fn start(program: &Path, session: &Session, speed: f64, delay_millis: u32) -> Self {
        let is_over: Arc<AtomicBool> = Arc::default();
        let (session, is_over_here) = (session.clone(), Arc::clone(&is_over));
        let server = PageServer::start(move |socket| session.play(socket, speed, &is_over_here));
        Self {
            browser: open(program, &server.url(), delay_millis),
            is_over,
        }
    }

    fn end(self) {
        self.is_over.store(true, Ordering::Relaxed);
        drop(self.browser);
    }
}

#[test]
fn a_recorded_session_keeps_the_main_thread_free_and_outdated_images_are_dropped() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let (session, report) = record(&program);
    let [pictures, images] = ["picture", "live_image"].map(|kind| session.binaries(kind));
    check_report(&report);
    check_times(&pictures);
    let n_states = session
        .texts()
        .filter(|message| message["type"] == "robot_state")
        .count();
    eprintln!(
        "{:?}: {} pictures, {} images, {n_states} robot states",
        session.duration(),
        pictures.len(),
        images.len()
    );
    assert!(
        pictures.len() > 20 && images.len() > 30 && n_states > 200,
        "too little was recorded"
    );
    for speed in [1.0, 2.0] {
        check_tasks(&program, &session, speed);
    }
    check_dropping(&program, &session, [pictures, images]);
}

/// The report of the run states when its pictures were shown.
fn check_report(report: &Value) {
    let latency = |name: &str| {
        let latencies = report["latencies"].as_array().expect("a list");
        let found = latencies
            .iter()
            .find(|pair| pair[0] == name)
            .map(|pair| pair[1].clone());
        found.unwrap_or_else(|| panic!("{name} is missing: {latencies:?}"))
    };
    let [model, sent, shown] =
        ["model", "sent", "shown"].map(|stage| latency(&format!("shutter to {stage}")));
    eprintln!("shutter to model {model}, sent {sent}, shown {shown}");
    assert!(
        model["p50"].as_f64().is_some_and(|millis| millis > 0.0),
        "{model}"
    );
    // Both latencies are about the same keyframes. More keyframes were added to the model than
    // shown.
    assert_eq!(sent["n"], shown["n"]);
    assert!(
        sent["p50"].as_f64() < shown["p50"].as_f64()
            && sent["p99"].as_f64() < shown["p99"].as_f64(),
        "{report}"
    );
    assert!(shown["n"].as_u64().is_some_and(|n| n >= 3), "{shown}");
}

/// Each picture is sent after its newest keyframe was added to the model, which is after the
/// shutter.
fn check_times(pictures: &[(Value, Vec<u8>)]) {
    let mut newest_keyframes = BTreeSet::new();
    for (header, _) in pictures {
        let newest = &header["newest_keyframe"];
        let times = [
            &newest["captured_millis"],
            &newest["added_millis"],
            &header["sent_millis"],
        ]
        .map(Value::as_f64);
        let [Some(captured), Some(added), Some(sent)] = times else {
            continue;
        };
        assert!(captured < added && added < sent, "{header}");
        newest_keyframes.insert(header["keyframes"].as_u64());
    }
    assert!(newest_keyframes.len() >= 3, "{newest_keyframes:?}");
}

/// Tasks of the main thread are short while a session is replayed. Other programs can lengthen
/// tasks, because processors share caches and clocks, so the shortest of three measurements counts.
fn check_tasks(program: &Path, session: &Session, speed: f64) {
    let mut p99 = f64::INFINITY;
    for _ in 0..3 {
        p99 = p99.min(p99_of_tasks(program, session, speed));
        if p99 < MAX_P99 {
            return;
        }
    }
    panic!("the 99th percentile is {p99:.2} times the reference");
}

/// The 99th percentile of the CPU time of tasks while a session is replayed, relative to a fixed
/// piece of work on the same page.
fn p99_of_tasks(program: &Path, session: &Session, speed: f64) -> f64 {
    let mut replay = Replay::start(program, session, speed, 0);
    // The recorded pictures need not answer the requests of this page.
    wait_for(&mut replay.browser, "a picture", |browser| {
        let shown = "(document.getElementById('picture-info')?.dataset.shownRequest ?? '') !== ''";
        browser.evaluate(shown) == json!(true)
    });
    let traced = session.duration().mul_f64(0.7 / speed);
    let tasks = replay.browser.trace_tasks(traced);
    eprintln!("{speed} times the speed:");
    let p99 = tasks.relative_p99();
    replay.end();
    p99
}

/// If images arrive faster than they can be decoded, at most one picture and one camera image is
/// decoded at a time, the newest one is next, and all others are dropped.
fn check_dropping(
    program: &Path,
    session: &Session,
    [pictures, images]: [Vec<(Value, Vec<u8>)>; 2],
) {
    let mut replay = Replay::start(program, session, 2.0, SLOW_DECODING_MILLIS);
    std::thread::sleep(session.duration().mul_f64(0.5) + Duration::from_secs(2));
    let browser = &mut replay.browser;
    wait_for(browser, "the last image", |browser| {
        browser.evaluate("window.decoders.nActive") == 0
    });
    let decoders = browser.evaluate("window.decoders");
    let n_received = pictures.len() + images.len();
    let n_decoded = decoders["n"]
        .as_u64()
        .and_then(|n| usize::try_from(n).ok())
        .expect("a count");
    eprintln!("{n_decoded} of {n_received} pictures and images were decoded: {decoders}");
    assert_eq!(
        decoders["maxActive"], 2,
        "one picture and one image of the only camera"
    );
    assert!(
        10 < n_decoded && n_decoded < n_received * 3 / 4,
        "{n_decoded} of {n_received} were decoded"
    );
    let sizes = decoders["sizes"].as_array().expect("a list");
    for received in [&pictures, &images] {
        let size = |(header, payload): &(Value, Vec<u8>)| {
            json!(
                header["color"]["bytes"]
                    .as_u64()
                    .unwrap_or(payload.len() as u64)
            )
        };
        let received: Vec<Value> = received.iter().map(size).collect();
        let last_decoded = sizes.iter().rev().find(|size| received.contains(size));
        assert_eq!(
            last_decoded,
            received.last(),
            "the newest is decoded last: {sizes:?}"
        );
    }
    replay.end();
}
