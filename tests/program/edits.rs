//! Tests edits end to end: erased space is not drawn in `view` and in live runs, and is saved,
//! exported, resumed and undone.

use crate::pictures::difference;
#[cfg(feature = "sim")]
use crate::small_rig;
use crate::wall;
use crate::wall::fieldrig;
use model_files::Edits;
#[cfg(feature = "sim")]
use model_files::checkpoint::Checkpoint;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tungstenite::{Message, WebSocket};

/// Maximum time until an expected message. Much longer than two busy cores need for a small
/// picture.
const TIMEOUT: Duration = Duration::from_secs(120);
/// Exit codes of a run that has saved its model: success, and dropped images. A busy computer drops
/// images.
const EXIT_CODES: [i32; 2] = [0, 3];
const SIZE_PX: [u32; 2] = [96, 72];
/// Upper bound on the difference caused by JPEG compression, as in `tests/program/view.rs`.
const MAX_JPEG_DIFFERENCE: f64 = 3.0;

/// Upper bound on the brightness in the middle of erased space. It is above 0 because faint
/// surfaces behind the erased space may be visible. Before the edit, the brightness is above 50.
const MAX_ERASED_BRIGHTNESS: f64 = 20.0;

/// A command that serves the page.
struct Serving {
    process: Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
    address: String,
}

impl Serving {
    fn start(folder: &Path, args: &[&str]) -> Self {
        let mut process = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
            .args(args)
            .args(["--json", "--listen", "127.0.0.1:0"])
            .current_dir(folder)
            .stdout(Stdio::piped())
            .spawn()
            .expect("fieldrig starts");
        let mut lines = BufReader::new(process.stdout.take().expect("piped")).lines();
        let line = lines
            .next()
            .expect("a line before the end")
            .expect("stdout is read");
        let serving: Value = serde_json::from_str(&line).expect("a JSON object");
        let url = serving["url"].as_str().expect("an address");
        let address = url
            .trim_start_matches("http://")
            .trim_end_matches('/')
            .to_owned();
        Self {
            process,
            lines,
            address,
        }
    }

    /// Ends the program with SIGINT, as Ctrl-C does.
    fn interrupt(mut self) {
        let kill = format!("kill -INT {}", self.process.id());
        assert!(
            Command::new("sh")
                .args(["-c", &kill])
                .status()
                .expect("sh starts")
                .success()
        );
        self.lines.by_ref().for_each(drop);
        let code = self.process.wait().expect("it ends").code();
        assert!(
            code.is_some_and(|code| EXIT_CODES.contains(&code)),
            "exit code {code:?}"
        );
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.process.kill(); // Fails if the process has already ended.
    }
}

/// An operator's connection.
struct Operator {
    socket: WebSocket<TcpStream>,
    n_sent: u64,
}

impl Operator {
    fn connect(serving: &Serving) -> Self {
        let stream = TcpStream::connect(&serving.address).expect("the server listens");
        stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
        let (socket, _) = tungstenite::client(format!("ws://{}/ws", serving.address), stream)
            .expect("a WebSocket");
        Self { socket, n_sent: 0 }
    }

    fn send(&mut self, message: &Value) {
        self.socket
            .send(Message::text(message.to_string()))
            .expect("sent");
    }

    /// The next message for which `find` returns a result.
    fn wait_for<T>(&mut self, mut find: impl FnMut(&Value, &[u8]) -> Option<T>) -> T {
        let began = Instant::now();
        loop {
            assert!(
                began.elapsed() < TIMEOUT,
                "the expected message did not come within {TIMEOUT:?}"
            );
            let found = match self.socket.read().expect("a message") {
                Message::Text(text) => find(&serde_json::from_str(&text).expect("JSON"), &[]),
                Message::Binary(bytes) => {
                    let (length, rest) = bytes.split_at(4);
                    let n_header = u32::from_le_bytes(length.try_into().expect("4 bytes")) as usize;
                    let (header, payload) = rest.split_at(n_header);
                    find(&serde_json::from_slice(header).expect("JSON"), payload)
                }
                _ => None,
            };
            if let Some(found) = found {
                return found;
            }
        }
    }

    /// Edits a model and waits until it has the expected number of edits. Returns the revision of
    /// the edits, or the reason if the edit failed.
    fn edit(&mut self, method: &str, mut message: Value, expected: u64) -> Result<u64, String> {
        self.n_sent += 1;
        let id = 1000 + self.n_sent;
        (message["type"], message["method"], message["id"]) =
            ("edit".into(), method.into(), id.into());
        self.send(&message);
        self.wait_for(|message, _| {
            if message["type"] == "error" && message["id"] == id {
                return Some(Err(message["message"]
                    .as_str()
                    .expect("a sentence")
                    .to_owned()));
            }
            let is_done =
                message["type"] == "status" && n_edits_of(message, method) == Some(expected);
            is_done.then(|| Ok(message["edit_revision"].as_u64().expect("a revision")))
        })
    }

    /// Removes floaters from a model that has this number of edits. If any floaters were removed,
    /// undoes the removal.
    fn search_floaters(&mut self, method: &str, n_edits: u64) {
        match self.edit(method, json!({"action": "remove_floaters"}), n_edits + 1) {
            Ok(_) => {
                _ = self
                    .edit(method, json!({"action": "undo"}), n_edits)
                    .expect("undone")
            }
            Err(reason) => assert!(reason.starts_with("no floaters found"), "{reason}"),
        }
    }

    /// Waits for a note in the status.
    fn wait_for_note(&mut self, words: &str) {
        self.wait_for(|message, _| {
            (message["type"] == "status" && message["notes"].to_string().contains(words))
                .then_some(())
        });
    }

    /// The picture of a model from a pose.
    fn picture(&mut self, method: &str, pose: &Value) -> image::RgbImage {
        self.n_sent += 1;
        let id = self.n_sent;
        let projection = json!({"kind": "pinhole", "vertical_fov_rad": 50_f64.to_radians()});
        self.send(&json!({
            "type": "render", "id": id, "method": method, "size_px": SIZE_PX, "stages": [1.0], "world_from_camera": pose,
            "projection": projection, "far_m": 1000.0,
        }));
        let decoded = |payload: &[u8]| {
            image::load_from_memory(payload)
                .expect("a JPEG")
                .into_rgb8()
        };
        self.wait_for(|header, payload| {
            (header["type"] == "picture" && header["id"] == id).then(|| decoded(payload))
        })
    }
}

/// Number of edits of a model, according to a status; `None` if there is no model of this method.
fn n_edits_of(status: &Value, method: &str) -> Option<u64> {
    let others = status["others"].as_array().into_iter().flatten();
    std::iter::once(status)
        .chain(others)
        .find(|model| model["method"] == method)?["edits"]
        .as_u64()
}

/// Mean brightness of 10x10 pixels around a position, on a scale of 0 to 255.
fn brightness_around(picture: &image::RgbImage, [x, y]: [u32; 2]) -> f64 {
    let part = image::imageops::crop_imm(picture, x - 5, y - 5, 10, 10).to_image();
    part.as_raw()
        .iter()
        .map(|value| f64::from(*value))
        .sum::<f64>()
        / part.as_raw().len() as f64
}

/// Renders a saved model from a pose with `fieldrig render`.
fn rendered(folder: &Path, model: &str, pose: &Value, out: &str) -> image::RgbImage {
    let pose: Vec<String> = pose
        .as_array()
        .expect("a pose")
        .iter()
        .map(Value::to_string)
        .collect();
    let (pose, size) = (pose.join(" "), format!("{}x{}", SIZE_PX[0], SIZE_PX[1]));
    let output = fieldrig(
        folder,
        &[
            "render", model, "--pose", &pose, "--size", &size, "--fov", "50", "--out", out,
        ],
    );
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    image::open(folder.join(out).join("00000.png"))
        .expect("a picture")
        .into_rgb8()
}

/// The number that `fieldrig export` prints first.
fn n_exported(folder: &Path, model: &str, out: &str) -> u64 {
    let output = fieldrig(folder, &["export", model, "--to", "ply", "--out", out]);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let printed = String::from_utf8(output.stdout).expect("UTF-8");
    let digits = printed
        .split_whitespace()
        .next()
        .expect("a number")
        .replace(',', "");
    digits
        .parse()
        .unwrap_or_else(|_| panic!("no number in {printed:?}"))
}

#[test]
fn edits_of_saved_models_are_drawn_saved_exported_and_undone() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    let train = [
        "train",
        "data",
        "--method",
        "tsdf,splat",
        "--max-splats",
        "2000",
        "--steps",
        "60",
        "--out",
        "all",
    ];
    assert!(fieldrig(folder, &train).status.success());
    let mesh_bytes = || {
        std::fs::metadata(folder.join("all/tsdf/mesh.ply"))
            .expect("a mesh")
            .len()
    };
    let n_whole = ["splat", "tsdf"]
        .map(|method| n_exported(folder, &format!("all/{method}"), &format!("{method}.ply")));
    let n_mesh_bytes = mesh_bytes();

    let view = Serving::start(folder, &["view", "all"]);
    let mut operator = Operator::connect(&view);
    let pose = operator.wait_for(|message, _| {
        (message["type"] == "scene").then(|| message["world_from_camera"].clone())
    });
    let [x, y] = [3, 7].map(|at| pose[at].as_f64().expect("a number"));
    // The edit is at the center of the view. The camera is at z = 1 m and looks down at the wall at
    // z = 0.
    let erase = json!({"action": "erase", "box": {"min_m": [x - 0.15, y - 0.15, -0.5], "max_m": [x + 0.15, y + 0.15, 0.5]}});
    for (method, n_whole) in ["splat", "tsdf"].iter().zip(n_whole) {
        let model = format!("all/{method}");
        let whole = operator.picture(method, &pose);
        operator.edit(method, erase.clone(), 1).expect("erased");
        let edited = operator.picture(method, &pose);
        let [center, corner] = [[48, 36], [10, 10]];
        assert!(
            brightness_around(&whole, center) > 50.0,
            "{method}: {}",
            brightness_around(&whole, center)
        );
        assert!(
            brightness_around(&edited, center) < MAX_ERASED_BRIGHTNESS,
            "{method}: {}",
            brightness_around(&edited, center)
        );
        let kept = brightness_around(&edited, corner) - brightness_around(&whole, corner);
        assert!(
            kept.abs() < 3.0,
            "{method}: the corner has changed by {kept}"
        );
        let unsaved = rendered(folder, &model, &pose, &format!("{method}-unsaved"));
        assert!(
            difference(&unsaved, &whole) < MAX_JPEG_DIFFERENCE,
            "{method}: not saved yet"
        );

        operator.send(&json!({"type": "control", "action": "save"}));
        operator.wait_for_note(&format!("edits saved in all/{method}"));
        assert_eq!(Edits::read(&folder.join(&model)).expect("edits").len(), 1);
        let saved = rendered(folder, &model, &pose, &format!("{method}-saved"));
        assert!(
            difference(&saved, &edited) < MAX_JPEG_DIFFERENCE,
            "{method}: {}",
            difference(&saved, &edited)
        );
        let n_left = n_exported(folder, &model, &format!("{method}-edited.ply"));
        assert!(
            n_left < n_whole && 2 * n_left > n_whole,
            "{method}: {n_left} of {n_whole}"
        );

        operator
            .edit(method, json!({"action": "undo"}), 0)
            .expect("undone");
        operator.search_floaters(method, 0);
        assert!(
            operator.picture(method, &pose) == whole,
            "{method}: after the undo"
        );
        let reason = operator
            .edit(method, json!({"action": "undo"}), 9)
            .expect_err("no edit is left");
        assert_eq!(reason, "there is nothing to undo");
    }
    assert!(
        mesh_bytes() < n_mesh_bytes,
        "the mesh file for other programs lacks the erased part"
    );
    let reason = operator
        .edit("nerf", json!({"action": "undo"}), 9)
        .expect_err("no such model");
    assert_eq!(
        reason,
        "no model with the method \"nerf\"; use splat or tsdf"
    );
    // After an undo and another edit, the number of edits is the same, but the revision differs.
    let revision = operator.edit("splat", erase.clone(), 1).expect("erased");
    operator
        .edit("splat", json!({"action": "undo"}), 0)
        .expect("undone");
    assert_eq!(operator.edit("splat", erase, 1), Ok(revision + 2));
    operator.send(&json!({"type": "control", "action": "save"}));
    operator.wait_for_note("edits saved in all/splat");
    view.interrupt();
    assert!(
        !folder.join("all/tsdf/edits.json").exists(),
        "the undo was saved, too"
    );
    assert_eq!(
        mesh_bytes(),
        n_mesh_bytes,
        "and the mesh file is complete again"
    );

    let again = Serving::start(folder, &["view", "all/splat"]);
    let mut operator = Operator::connect(&again);
    operator.wait_for(|message, _| {
        (message["type"] == "status" && message["edits"] == 1).then_some(())
    });
    assert!(
        brightness_around(&operator.picture("splat", &pose), [48, 36]) < MAX_ERASED_BRIGHTNESS,
        "the saved edits are drawn"
    );
    again.interrupt();
    save_copies_of_file(folder, [x, y]);
}

/// Edits of the splat file `splat.ply` are saved as new files, and undone edits can be redone.
///
/// * `[x, y]`: point on the wall, meters.
fn save_copies_of_file(folder: &Path, [x, y]: [f64; 2]) {
    let n_splats = |name: &str| {
        let splats = model_files::splat::file::read(&folder.join(name)).expect("splats");
        splats.n_splats()
    };
    let original = std::fs::read(folder.join("splat.ply")).expect("the exported file");
    let view = Serving::start(folder, &["view", "splat.ply"]);
    let mut operator = Operator::connect(&view);
    let erase = json!({"action": "erase", "box": {"min_m": [x - 0.15, y - 0.15, -0.5], "max_m": [x + 0.15, y + 0.15, 0.5]}});
    operator.edit("splat", erase, 1).expect("erased");
    operator
        .edit("splat", json!({"action": "undo"}), 0)
        .expect("undone");
    operator
        .edit("splat", json!({"action": "redo"}), 1)
        .expect("redone");
    let reason = operator
        .edit("splat", json!({"action": "redo"}), 9)
        .expect_err("nothing is left to redo");
    assert_eq!(reason, "there is nothing to redo");
    for name in ["splat-edited-2.ply", "splat-edited-3.ply"] {
        // The export of the edited model above has the first name.
        operator.send(&json!({"type": "control", "action": "save"}));
        let saved = operator.wait_for(|message, _| {
            let text = message["saved_edits"]["text"].as_str()?;
            text.contains(name)
                .then(|| message["saved_edits"]["has_failed"].clone())
        });
        assert_eq!(saved, json!(false));
        assert_eq!(n_splats(name), n_splats("splat-edited.ply"));
    }
    assert!(n_splats("splat-edited.ply") < n_splats("splat.ply"));
    view.interrupt();
    assert_eq!(
        std::fs::read(folder.join("splat.ply")).expect("the file"),
        original
    );
}

#[cfg(feature = "sim")]
#[test]
fn edits_of_a_live_run_are_kept_in_its_checkpoint_and_model() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    small_rig::write(folder, small_rig::Pace::RealTime);
    let pose = json!([1, 0, 0, 0.5, 0, -1, 0, 0, 0, 0, -1, 0.6, 0, 0, 0, 1]);
    // The camera is at (0.5, 0, 0.6) and looks down at the table.
    let erase =
        json!({"action": "erase", "box": {"min_m": [0.4, -0.1, -0.3], "max_m": [0.6, 0.1, 0.4]}});
    let center = [48, 36];

    let live = Serving::start(
        folder,
        &[
            "run", "rig.toml", "--sim", "--method", "tsdf", "--out", "live",
        ],
    );
    let mut operator = Operator::connect(&live);
    operator.wait_for(|message, _| {
        (message["type"] == "status" && message["step"].as_u64() >= Some(8)).then_some(())
    });
    let is_drawn = |operator: &mut Operator| {
        brightness_around(&operator.picture("tsdf", &pose), center) > 10.0
    };
    let began = Instant::now();
    while !is_drawn(&mut operator) {
        assert!(
            began.elapsed() < TIMEOUT,
            "nothing is drawn within {TIMEOUT:?}"
        );
    }
    operator.edit("tsdf", erase.clone(), 1).expect("erased");
    assert!(!is_drawn(&mut operator), "the center is erased");
    operator
        .edit("tsdf", erase.clone(), 2)
        .expect("erased again");
    operator
        .edit("tsdf", json!({"action": "undo"}), 1)
        .expect("undone");
    operator.search_floaters("tsdf", 1);
    let step_of = |message: &Value| message["step"].as_u64();
    let step = operator.wait_for(|message, _| step_of(message));
    operator.wait_for(|message, _| (step_of(message) > Some(step + 3)).then_some(()));
    assert!(
        !is_drawn(&mut operator),
        "it stays erased while keyframes are fused"
    );
    live.interrupt();
    let edits = Edits::read(&folder.join("live")).expect("edits");
    assert_eq!(edits.len(), 1);
    assert!(
        Checkpoint::read(&folder.join("live/training.ckpt"))
            .expect("a checkpoint")
            .edits
            == edits
    );

    let view = Serving::start(folder, &["view", "live"]);
    let mut operator = Operator::connect(&view);
    operator
        .edit("tsdf", erase, 2)
        .expect("erased in the saved model");
    operator.send(&json!({"type": "control", "action": "save"}));
    operator.wait_for_note("edits saved in live");
    view.interrupt();

    let resumed = Serving::start(
        folder,
        &[
            "run", "rig.toml", "--sim", "--resume", "live", "--out", "resumed",
        ],
    );
    let mut operator = Operator::connect(&resumed);
    operator.wait_for(|message, _| {
        (message["type"] == "status" && message["edits"] == 2).then_some(())
    });
    assert!(
        !is_drawn(&mut operator),
        "the resumed run continues with the edits, including the one made in `view`"
    );
    operator
        .edit("tsdf", json!({"action": "undo"}), 1)
        .expect("undone");
    operator
        .edit("tsdf", json!({"action": "undo"}), 0)
        .expect("undone");
    assert!(is_drawn(&mut operator), "undone in the resumed run");
    resumed.interrupt();
    assert!(!folder.join("resumed/edits.json").exists());
}
