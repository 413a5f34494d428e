//! Opens the bundled page in a real browser, records a video along a camera path, and plays it.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::local_server::serve;
use crate::request_thread::RequestThread;
use analytic_scene::{draw, looking_along_y};
use nalgebra::Vector3;
use serde_json::json;
use std::sync::{Arc, Mutex};
use test_support::browser::{Browser, NO_DRAWING, browser_for_page, wait_for};
use trainer::RenderRequest;
use viz::{Hub, SceneHint};

const WINDOW_PX: [u32; 2] = [900, 500];
/// Two views, two seconds, 30 pictures per second.
const N_FRAMES: usize = 61;
/// Pixels that are compared, per side.
const N_SAMPLES: u32 = 12;
/// Mean difference of a frame to the server's picture, of 255.
const MAX_DIFFERENCE: f64 = 8.0;

/// Keeps the downloaded file.
const KEEP_FILE: &str = "
    window.file = null;
    window.createUrl = URL.createObjectURL.bind(URL);
    URL.createObjectURL = (blob) => { window.file = blob; return window.createUrl(blob); };";

/// Reads the number of frames from the table of sample sizes, and shows a frame: size, duration,
/// and sampled colors.
const PLAY: &str = "(async () => {
    const bytes = new Uint8Array(await window.file.arrayBuffer());
    const table = bytes.findIndex((_, at) => String.fromCharCode(...bytes.subarray(at, at + 4)) === 'stsz');
    const video = document.createElement('video');
    const event = (name) => new Promise((done, failed) => {
        video.addEventListener(name, done, { once: true });
        video.addEventListener('error', () => failed(video.error?.message), { once: true });
    });
    video.muted = true;
    video.src = window.createUrl(window.file);
    await event('loadeddata');
    // The event of a seek may come before the frame can be drawn.
    const shown = new Promise((done, failed) => {
        let newest = 'no frame';
        const check = (_, { mediaTime }) => {
            newest = `a frame of ${mediaTime} s`;
            if (Math.abs(mediaTime - FRAME / 30) < 0.5 / 30) done();
            else video.requestVideoFrameCallback(check);
        };
        video.requestVideoFrameCallback(check);
        video.addEventListener('error', () => failed(video.error?.message), { once: true });
        setTimeout(() => failed(`at ${video.currentTime} s, ${newest} is shown`), 120000);
    });
    video.currentTime = (FRAME + 0.5) / 30;
    await shown;
    const canvas = new OffscreenCanvas(video.videoWidth, video.videoHeight);
    const context = canvas.getContext('2d');
    context.drawImage(video, 0, 0);
    const colors = [];
    for (let y = 0; y < SAMPLES; y++) {
        for (let x = 0; x < SAMPLES; x++) {
            const at = [(x + 0.5) / SAMPLES * canvas.width, (y + 0.5) / SAMPLES * canvas.height].map(Math.floor);
            colors.push(...context.getImageData(...at, 1, 1).data.slice(0, 3));
        }
    }
    return {
        nFrames: new DataView(bytes.buffer).getUint32(table + 12),
        duration: video.duration, size: [canvas.width, canvas.height], colors, bytes: bytes.length,
    };
})()";

/// Draws pictures. Those of the video have no depth.
struct Renderer {
    requests: Arc<Mutex<Vec<RenderRequest>>>,
    _thread: RequestThread,
}

impl Renderer {
    fn start(hub: Hub) -> Self {
        let requests: Arc<Mutex<Vec<RenderRequest>>> = Arc::default();
        let received = Arc::clone(&requests);
        let thread = RequestThread::start(hub, move |pending| {
            received
                .lock()
                .expect("no panic")
                .push(pending.request.clone());
            let picture = draw(&pending.request);
            pending.deliver(picture);
        });
        Self {
            requests,
            _thread: thread,
        }
    }

    fn requests(&self, is_video: bool) -> Vec<RenderRequest> {
        let requests = self.requests.lock().expect("no panic");
        requests
            .iter()
            .filter(|request| request.depth != is_video)
            .cloned()
            .collect()
    }
}

#[test]
fn a_recorded_video_has_every_frame() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.2],
        radius_m: 0.8,
        world_from_camera: looking_along_y(),
    });
    let server = serve(&hub);
    let renderer = Renderer::start(hub);
    let script = format!("{NO_DRAWING}{KEEP_FILE}");
    let mut browser = Browser::open_with(&program, &server.url(), WINDOW_PX, &script);
    // The page may not play videos, but this test does.
    browser.call("Page.setBypassCSP", json!({"enabled": true}));
    browser.evaluate("window.isOld = true");
    browser.call("Page.reload", json!({}));
    wait_for(&mut browser, "a full picture", |browser| {
        browser.evaluate("window.isOld") != true && browser.text("picture-text").contains("100 %")
    });
    assert_eq!(
        browser.evaluate("document.getElementById('path-video').disabled"),
        true
    );
    browser.click("path-add");
    browser.click("look-front");
    browser.click("path-add");

    browser.click("path-video");
    assert_eq!(browser.text("path-video"), "Cancel");
    wait_for(&mut browser, "the first pictures", |_| {
        renderer.requests(true).len() > 2
    });
    browser.click("look-top");
    wait_for(&mut browser, "a picture of the main view", |_| {
        renderer.requests(false).last().is_some_and(|request| {
            (request.world_from_camera.rotation * Vector3::z() + Vector3::z()).norm() < 0.01
        })
    });
    assert!(
        renderer.requests(true).len() < N_FRAMES,
        "the main view is drawn during the recording"
    );
    wait_for(&mut browser, "a file", |browser| {
        browser.evaluate("window.file !== null") == true
    });
    assert_eq!(browser.text("path-video"), "Video");
    let requests = renderer.requests(true);
    assert_eq!(requests.len(), N_FRAMES, "one picture for each frame");
    for frame in [0, 30, N_FRAMES - 1] {
        check_frame(&mut browser, &requests[frame], frame);
    }

    // A cancelled recording leaves no file.
    browser.evaluate("window.file = null");
    browser.click("path-video");
    wait_for(&mut browser, "a picture", |browser| {
        browser.text("path-count").starts_with("picture ")
    });
    browser.click("path-video");
    wait_for(&mut browser, "the end", |browser| {
        browser.text("path-video") == "Video"
    });
    assert_eq!(browser.text("path-count"), "2 views");
    assert_eq!(browser.evaluate("window.file"), json!(null));
    assert_eq!(browser.text("path-note"), "");
    browser
        .evaluate("delete window.VideoEncoder; Object.defineProperty(window, 'isSecureContext', { value: false }); 0");
    browser.click("path-video");
    assert!(
        browser
            .text("path-note")
            .contains("start fieldrig with --share"),
        "{}",
        browser.text("path-note")
    );
    drop(browser);
    drop(renderer);
}

/// The frame of the video shows the picture of the request.
fn check_frame(browser: &mut Browser, request: &RenderRequest, frame: usize) {
    let script = PLAY
        .replace("FRAME", &frame.to_string())
        .replace("SAMPLES", &N_SAMPLES.to_string());
    let played = browser.call(
        "Runtime.evaluate",
        json!({"expression": script, "awaitPromise": true, "returnByValue": true}),
    );
    let video = &played["result"]["value"];
    assert_eq!(video["nFrames"], json!(N_FRAMES), "{played}");
    let duration = video["duration"].as_f64().expect("a duration");
    assert!(
        (duration - N_FRAMES as f64 / 30.0).abs() < 0.01,
        "{duration} s"
    );
    assert_eq!(video["size"], json!(request.size_px), "{video}");
    let colors: Vec<f64> = serde_json::from_value(video["colors"].clone()).expect("colors");
    let picture = draw(request);
    let at = |sample: u32, axis: usize| (2 * sample + 1) * request.size_px[axis] / (2 * N_SAMPLES);
    let samples = (0..N_SAMPLES).flat_map(|y| (0..N_SAMPLES).map(move |x| (x, y)));
    let expected = samples.flat_map(|(x, y)| {
        let ix = 4 * (at(y, 1) * request.size_px[0] + at(x, 0)) as usize;
        picture.rgba_srgb[ix..ix + 3]
            .iter()
            .map(|value| f64::from(*value))
            .collect::<Vec<_>>()
    });
    let mean = colors
        .iter()
        .zip(expected)
        .map(|(a, b)| (a - b).abs())
        .sum::<f64>()
        / colors.len() as f64;
    eprintln!(
        "frame {frame}: {mean:.1} of 255, file of {} bytes",
        video["bytes"]
    );
    assert!(
        mean < MAX_DIFFERENCE,
        "frame {frame} differs by {mean} of 255"
    );
}
