//! Tests `fieldrig view` and the report page of training: what a browser receives, and which
//! requests are rejected.

use crate::command::assert_one_error;
use crate::pictures::difference;
use crate::wall;
use crate::wall::fieldrig;
use gpu::{Gpu, GpuOptions};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;
use tungstenite::{Message, WebSocket};

/// Much longer than two busy cores need for a small picture.
const TIMEOUT: Duration = Duration::from_secs(120);
const SIZE_PX: [u32; 2] = [96, 72];
/// Angle from the top to the bottom of a picture, degrees.
const FOV_DEGREES: f64 = 50.0;

/// Trains on the photos of a wall; returns the output.
fn train(folder: &Path, args: &[&str]) -> String {
    let output = fieldrig(folder, &[&["train"], args].concat());
    assert!(
        output.status.success(),
        "{args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).expect("stdout is UTF-8")
}

/// A running `fieldrig view`.
struct View {
    process: Child,
    serving: Value,
}

impl View {
    fn start(folder: &Path, args: &[&str]) -> Self {
        let mut process = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
            .args(["view", "--json"])
            .args(args)
            .current_dir(folder)
            .env("XDG_DATA_HOME", folder.join("data-home"))
            .stdout(Stdio::piped())
            .spawn()
            .expect("fieldrig starts");
        let mut lines = BufReader::new(process.stdout.take().expect("piped")).lines();
        let line = lines
            .next()
            .expect("a line before the end")
            .expect("stdout is read");
        Self {
            process,
            serving: serde_json::from_str(&line).expect("a JSON object"),
        }
    }

    fn address(&self) -> SocketAddr {
        let url = self.serving["url"].as_str().expect("an address");
        url.trim_start_matches("http://")
            .trim_end_matches('/')
            .parse()
            .expect("numbers")
    }

    /// Ends the program with SIGINT, as Ctrl-C does.
    fn interrupt(mut self) -> ExitStatus {
        let kill = format!("kill -INT {}", self.process.id());
        assert!(
            Command::new("sh")
                .args(["-c", &kill])
                .status()
                .expect("sh starts")
                .success()
        );
        self.process.wait().expect("it ends")
    }
}

impl Drop for View {
    fn drop(&mut self) {
        let _ = self.process.kill(); // Fails if the process has already ended.
    }
}

/// A connected page.
struct Client {
    socket: WebSocket<TcpStream>,
    n_requested: u64,
}

impl Client {
    fn connect(view: &View) -> Self {
        let address = view.address();
        let stream = TcpStream::connect(address).expect("the server listens");
        stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
        let (socket, _) =
            tungstenite::client(format!("ws://{address}/ws"), stream).expect("a WebSocket");
        Self {
            socket,
            n_requested: 0,
        }
    }

    /// The next message: JSON, and the payload of a binary one.
    fn receive(&mut self) -> (Value, Vec<u8>) {
        loop {
            match self.socket.read().expect("an answer") {
                Message::Text(text) => {
                    return (serde_json::from_str(&text).expect("JSON"), Vec::new());
                }
                Message::Binary(bytes) => {
                    let (length, rest) = bytes.split_at(4);
                    let (header, payload) = rest
                        .split_at(u32::from_le_bytes(length.try_into().expect("4 bytes")) as usize);
                    return (
                        serde_json::from_slice(header).expect("JSON"),
                        payload.to_vec(),
                    );
                }
                _ => {}
            }
        }
    }

    /// The first message of each of these types.
    fn first<const N: usize>(&mut self, types: [&str; N]) -> [Value; N] {
        let mut found = types.map(|_| Value::Null);
        while found.iter().any(Value::is_null) {
            let (message, _) = self.receive();
            if let Some(ix) = types.iter().position(|kind| message["type"] == *kind) {
                found[ix] = message;
            }
        }
        found
    }

    /// The decoded picture from a pose, or the reason why there is none.
    fn request_picture(
        &mut self,
        pose: &[f64],
        method: Option<&str>,
    ) -> Result<image::RgbImage, String> {
        self.n_requested += 1;
        let mut message = json!({
            "type": "render", "id": self.n_requested, "size_px": SIZE_PX, "stages": [1.0], "world_from_camera": pose,
            "projection": { "kind": "pinhole", "vertical_fov_rad": FOV_DEGREES.to_radians() }, "far_m": 1000.0,
        });
        if let Some(method) = method {
            message["method"] = method.into();
        }
        self.socket
            .send(Message::text(message.to_string()))
            .expect("sent");
        loop {
            let (answer, payload) = self.receive();
            if answer["id"] != json!(self.n_requested) {
                continue;
            }
            if answer["type"] == "error" {
                return Err(answer["message"].as_str().expect("a sentence").to_owned());
            }
            return Ok(image::load_from_memory(&payload)
                .expect("a JPEG")
                .into_rgb8());
        }
    }
}

/// Headers of all chunks of a model, in full.
fn chunks(client: &mut Client, method: &str) -> Vec<Value> {
    let message =
        json!({"type": "subscribe", "topic": "model_chunks", "rate_hz": 1, "method": method});
    client
        .socket
        .send(Message::text(message.to_string()))
        .expect("sent");
    let mut fine = Vec::new();
    loop {
        let (header, payload) = client.receive();
        if header["type"] == "model_chunk" && header["is_coarse"] == false {
            assert!(
                header["method"] == method && !payload.is_empty(),
                "{header}"
            );
            let is_last = header["n_incomplete"] == 0;
            fine.push(header);
            if is_last {
                return fine;
            }
        }
    }
}

/// Checks the map of observations, for which depth is rendered from all cameras.
fn check_observations(client: &mut Client) {
    let message = json!({"type": "subscribe", "topic": "observations", "rate_hz": 10});
    client
        .socket
        .send(Message::text(message.to_string()))
        .expect("sent");
    let (header, payload) = loop {
        let (header, payload) = client.receive();
        if header["type"] == "observations" && header["n_keyframes"] == 10 {
            break (header, payload);
        }
    };
    assert!(
        header["newest_millis"].is_null()
            && header["cell_m"].as_f64().is_some_and(|cell| cell > 0.0),
        "{header}"
    );
    let mut codes = Vec::new();
    flate2::read::ZlibDecoder::new(&payload[..])
        .read_to_end(&mut codes)
        .expect("a zlib stream");
    let n_cells: u64 = (0..3)
        .map(|axis| header["n_cells"][axis].as_u64().expect("a number"))
        .product();
    assert_eq!(codes.len() as u64, 2 * n_cells);
    let (ages, sigmas) = codes.split_at(codes.len() / 2);
    let n_observed = ages.iter().filter(|age| **age > 0).count();
    assert!(
        n_observed > 100 && n_observed < ages.len(),
        "{n_observed} of {}",
        ages.len()
    );
    // The cameras look at the wall from different directions, so most positions are determined
    // without measured depth.
    let n_determined = sigmas
        .iter()
        .filter(|sigma| (1..255).contains(*sigma))
        .count();
    assert!(
        2 * n_determined > n_observed,
        "{n_determined} of {n_observed}"
    );
}

fn sum_of(chunks: &[Value], field: &str) -> u64 {
    chunks
        .iter()
        .map(|chunk| chunk[field].as_u64().expect("a number"))
        .sum()
}

fn pose_of(message: &Value) -> Vec<f64> {
    let pose = message["world_from_camera"].as_array().expect("a pose");
    pose.iter()
        .map(|number| number.as_f64().expect("a number"))
        .collect()
}

/// Renders a model from a pose with `fieldrig render`.
fn rendered(folder: &Path, model: &str, pose: &[f64], out: &str) -> image::RgbImage {
    let pose = pose
        .iter()
        .map(f64::to_string)
        .collect::<Vec<_>>()
        .join(" ");
    let (size, fov) = (
        format!("{}x{}", SIZE_PX[0], SIZE_PX[1]),
        FOV_DEGREES.to_string(),
    );
    let args = [
        "render", model, "--pose", &pose, "--size", &size, "--fov", &fov, "--out", out, "--json",
    ];
    let output = fieldrig(folder, &args);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    image::open(folder.join(out).join("00000.png"))
        .expect("a picture")
        .into_rgb8()
}

/// Mean brightness, on a scale of 0 to 255.
fn brightness(picture: &image::RgbImage) -> f64 {
    picture
        .as_raw()
        .iter()
        .map(|value| f64::from(*value))
        .sum::<f64>()
        / picture.as_raw().len() as f64
}

/// Upper bound on the difference caused by JPEG compression at quality 92 in these pictures. The
/// measured difference is 1.0.
const MAX_JPEG_DIFFERENCE: f64 = 3.0;

#[test]
fn view_matches_render() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    let methods = [
        "--method",
        "tsdf,splat,nerf",
        "--max-splats",
        "2000",
        "--steps",
        "60",
        "--out",
        "all",
    ];
    train(folder, &[&["data"], &methods[..]].concat());

    let view = View::start(folder, &["all", "--listen", "127.0.0.1:0"]);
    assert_eq!(view.serving["methods"], json!(["splat", "tsdf", "nerf"]));
    let mut client = Client::connect(&view);
    let [status, scene, keyframes] = client.first(["status", "scene", "keyframes"]);
    assert_eq!(
        (&status["state"], &status["method"]),
        (&json!("viewing"), &json!("splat"))
    );
    let methods = status["others"]
        .as_array()
        .expect("a list")
        .iter()
        .map(|model| model["method"].clone());
    assert_eq!(methods.collect::<Vec<_>>(), ["tsdf", "nerf"]);
    let report = std::fs::read_to_string(folder.join("all/splat/report.json")).expect("a report");
    let report: Value = serde_json::from_str(&report).expect("JSON");
    assert_eq!(
        (&status["psnr"], &status["step"]),
        (&report["done"]["psnr"], &json!(60))
    );
    assert_eq!(status["primitives"], report["done"]["primitives"]);
    let cameras = keyframes["keyframes"].as_array().expect("cameras");
    assert_eq!((cameras.len(), &status["keyframes"]), (10, &json!(10)));

    // The view starts at the first camera.
    let start = pose_of(&scene);
    for (number, of_camera) in start.iter().zip(pose_of(&cameras[0])) {
        assert!((number - of_camera).abs() < 1e-9, "{scene} {}", cameras[0]);
    }
    for method in ["splat", "tsdf", "nerf"] {
        let received = client
            .request_picture(&start, Some(method))
            .expect("a picture");
        let expected = rendered(
            folder,
            &format!("all/{method}"),
            &start,
            &format!("picture-{method}"),
        );
        let difference = difference(&received, &expected);
        assert!(difference < MAX_JPEG_DIFFERENCE, "{method}: {difference}");
        assert!(
            brightness(&received) > 30.0,
            "{method}: the picture is dark"
        );
    }
    assert_eq!(
        client.request_picture(&start, None),
        client.request_picture(&start, Some("splat"))
    );
    let have_chunks = status["others"]
        .as_array()
        .expect("a list")
        .iter()
        .map(|model| model["has_chunks"].clone());
    assert!(
        status["has_chunks"] == true && have_chunks.eq([json!(true), json!(false)]),
        "{status}"
    );
    let n_splats = sum_of(&chunks(&mut client, "splat"), "n_splats");
    let n_all = status["primitives"].as_u64().expect("a number");
    assert!(
        n_splats <= n_all && 2 * n_splats > n_all,
        "{n_splats} of {n_all} splats are visible"
    );
    assert!(sum_of(&chunks(&mut client, "tsdf"), "n_triangles") > 1000);
    check_observations(&mut client);
    let refused = client
        .request_picture(&start, Some("mesh"))
        .expect_err("no such model");
    assert!(
        refused.contains("\"mesh\"") && refused.contains("splat or tsdf or nerf"),
        "{refused}"
    );
    assert_eq!(view.interrupt().code(), Some(0));

    check_view_without_cameras(folder);
}

/// Checks that a model without a list of cameras is first shown from outside, for each up axis.
fn check_view_without_cameras(folder: &Path) {
    let model = folder.join("all/splat/splats.ply");
    std::fs::copy(&model, folder.join("lone.ply")).expect("the disk has space");
    std::fs::remove_file(folder.join("all/tsdf/cameras.json")).expect("a list of cameras");
    std::fs::remove_file(folder.join("all/nerf/cameras.json")).expect("a list of cameras");
    for (model, up) in [
        ("lone.ply", "z"),
        ("lone.ply", "-y"),
        ("all/tsdf", "z"),
        ("all/nerf", "z"),
    ] {
        let view = View::start(folder, &[model, "--up", up, "--listen", "127.0.0.1:0"]);
        let mut client = Client::connect(&view);
        let [status, scene] = client.first(["status", "scene"]);
        assert_eq!(status["keyframes"], 0);
        assert_eq!(
            status["psnr"].is_null(),
            model == "lone.ply",
            "only a folder has a report: {status}"
        );
        let start = pose_of(&scene);
        // The camera is upright, so its x axis is level and its y axis points down.
        assert!(start[8].abs() < 1e-9 && start[9] < -0.1, "{start:?}");
        let received = client.request_picture(&start, None).expect("a picture");
        assert!(
            brightness(&received) > 2.0,
            "{model}, {up} up: nothing is visible from {start:?}"
        );
        if up == "-y" {
            // Up on the page is -y in the model, because the page's world is rotated by a quarter
            // turn about x.
            let [x, y, z] = [
                [1.0, 0.0, 0.0, 0.0],
                [0.0, 0.0, -1.0, 0.0],
                [0.0, 1.0, 0.0, 0.0],
            ];
            let row = |row: [f64; 4]| (0..4).map(move |column| (row, column));
            let product = |(row, column): ([f64; 4], usize)| {
                (0..4).map(|k| row[k] * start[4 * k + column]).sum::<f64>()
            };
            let in_model: Vec<f64> = [x, y, z, [0.0, 0.0, 0.0, 1.0]]
                .into_iter()
                .flat_map(row)
                .map(product)
                .collect();
            let expected = rendered(folder, model, &in_model, "picture-turned");
            let difference = difference(&received, &expected);
            assert!(difference < MAX_JPEG_DIFFERENCE, "{difference}");
            let [x, y, z] = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]];
            let page_from_model = [x, y, z, [0, 0, 0, 1]].concat();
            for chunk in chunks(&mut client, "splat") {
                let differs = |(a, b): (&f64, &i32)| (a - f64::from(*b)).abs() > 1e-9;
                let pose = chunk["world_from_model"]
                    .as_array()
                    .expect("a pose")
                    .iter()
                    .filter_map(Value::as_f64);
                assert!(
                    !pose
                        .collect::<Vec<_>>()
                        .iter()
                        .zip(&page_from_model)
                        .any(differs),
                    "{chunk}"
                );
            }
        }
        assert_eq!(view.interrupt().code(), Some(0));
    }
}

/// Asserts the exit code and one error message on stderr that contains all `words`.
fn assert_fails_with(folder: &Path, args: &[&str], code: i32, words: &[&str]) {
    assert_one_error(args, &fieldrig(folder, args), code, words);
}

#[test]
fn non_model_paths_give_one_error() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("data"), false, 0.0);
    let write = |name: &str, bytes: &[u8]| {
        std::fs::write(folder.join(name), bytes).expect("the disk has space")
    };
    std::fs::create_dir(folder.join("cut")).expect("the disk has space");
    write("cut/training.ckpt", b"a checkpoint");
    write("scan.mcap", b"\x89MCAP0\r\n");
    write("new.spz", b"NGSP\x05\0\0\0and so on");
    write("scene.sog", b"PK\x03\x04");
    write("torn.ply", b"ply\n");
    let refused = |model: &str, code: i32, words: &[&str]| {
        assert_fails_with(folder, &["view", model], code, words)
    };
    refused("absent", 1, &["absent does not exist"]);
    refused(
        "cut",
        1,
        &["cut contains no model", "train DATA --resume cut`"],
    );
    refused(
        "scan.mcap",
        2,
        &[
            "scan.mcap is a recording, not a model",
            "run RIG.toml --from scan.mcap",
        ],
    );
    refused(
        "data",
        2,
        &["data is a dataset, not a model", "fieldrig train data"],
    );
    refused("new.spz", 1, &["new.spz", "version 5", "expected 2 to 4"]);
    refused(
        "scene.sog",
        1,
        &[
            "scene.sog",
            "format .sog is not supported",
            "convert the file to .ply",
        ],
    );
    refused("torn.ply", 1, &["torn.ply"]);
    refused("data/00.png", 2, &["00.png is not a file of splats"]);
    refused("http://127.0.0.1:7007/", 2, &["open it in a browser"]);
    assert_fails_with(
        folder,
        &["view", "absent", "--up", "north"],
        2,
        &["--up", "-z"],
    );
    assert_fails_with(
        folder,
        &["view", "absent", "--listen", "7007"],
        2,
        &["127.0.0.1:7007"],
    );
}

#[test]
fn explicit_port_in_use_is_an_error_default_falls_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("data"), false, 0.0);
    train(
        folder,
        &[
            "data",
            "--steps",
            "1",
            "--max-splats",
            "500",
            "--out",
            "model",
        ],
    );
    let occupied = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = occupied.local_addr().expect("bound").to_string();
    assert_fails_with(
        folder,
        &["view", "model", "--listen", &address],
        1,
        &[&address, "in use", "--listen"],
    );
    // The default port is in use after this, by this test or by another program.
    let _default_port = TcpListener::bind("127.0.0.1:7007");
    let view = View::start(folder, &["model"]);
    assert_ne!(view.address().port(), 7007);
    TcpStream::connect(view.address()).expect("the server listens");
    assert_eq!(view.interrupt().code(), Some(0));
}

#[cfg(unix)]
#[test]
fn shared_page_has_new_tokens_and_the_same_certificate() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("data"), false, 0.0);
    train(
        folder,
        &[
            "data",
            "--steps",
            "1",
            "--max-splats",
            "500",
            "--out",
            "model",
        ],
    );
    let serve = || {
        let view = View::start(folder, &["model", "--share", "--listen", "127.0.0.1:0"]);
        let serving = view.serving.clone();
        let text = |name: &str| serving[name].as_str().expect("text").to_owned();
        let urls = [text("url"), text("viewer_url")];
        let tokens = urls.each_ref().map(|url| {
            let (address, token) = url.split_once("/#token=").expect("a token in the fragment");
            let address = address.strip_prefix("https://").expect("https");
            let mut stream = TcpStream::connect(address).expect("the server listens");
            stream.write_all(b"GET / HTTP/1.0\r\n\r\n").expect("sent");
            let mut answer = String::new();
            let _ = stream.read_to_string(&mut answer); // A reset may follow the answer.
            assert!(
                answer.contains("open its address with https://"),
                "{answer}"
            );
            token.to_owned()
        });
        assert_eq!(view.interrupt().code(), Some(0));
        (tokens, text("certificate_sha256"))
    };
    let (first_tokens, first_fingerprint) = serve();
    let (tokens, fingerprint) = serve();
    assert_eq!(fingerprint, first_fingerprint);
    assert_eq!(
        first_tokens
            .iter()
            .chain(&tokens)
            .collect::<std::collections::BTreeSet<_>>()
            .len(),
        4,
        "all differ"
    );
    let file = folder.join("data-home/fieldrig/page-certificate.pem");
    assert_eq!(
        file.metadata().expect("it is kept").permissions().mode() & 0o777,
        0o600
    );
}

#[test]
fn printed_commands_work_and_report_page_is_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("my data"), true, 0.0);
    // The training curve needs two scores, and the second is taken after half a second.
    let n_steps = if Gpu::open(&GpuOptions::default())
        .expect("an adapter")
        .is_software()
    {
        "200"
    } else {
        "2000"
    };
    let args = [
        "my data",
        "--steps",
        n_steps,
        "--max-splats",
        "2000",
        "--scale",
        "0.75",
        "--out",
        "my runs/first one",
    ];
    let printed = train(folder, &args);
    let verdict = printed.lines().last().expect("a line");
    assert!(
        verdict.contains(" dB on 2 test images. Next: ")
            && verdict.contains(" view 'my runs/first one'"),
        "{verdict}"
    );
    let commands: Vec<&str> = printed
        .lines()
        .filter(|line| *line != verdict)
        .skip_while(|line| !line.starts_with("saved in "))
        .skip(1)
        .map(|line| {
            line.split_once(":  ")
                .unwrap_or_else(|| panic!("{line:?} is no command"))
                .1
                .trim_start()
        })
        .collect();
    let verbs: Vec<&str> = commands
        .iter()
        .map(|command| command.split(' ').nth(1).expect("a verb"))
        .collect();
    assert_eq!(verbs, ["view", "eval", "export"], "{printed}");
    for command in &commands[1..] {
        let output = Command::new("sh")
            .args(["-c", command])
            .current_dir(folder)
            .output()
            .expect("sh starts");
        assert!(
            output.status.success(),
            "{command}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        let stdout = String::from_utf8_lossy(&output.stdout);
        if command.contains(" eval ") {
            let report = std::fs::read_to_string(folder.join("my runs/first one/report.json"))
                .expect("a report");
            let report: Value = serde_json::from_str(&report).expect("JSON");
            let psnr = format!(
                "PSNR {:.2} dB",
                report["done"]["psnr"].as_f64().expect("a score")
            );
            assert!(
                stdout
                    .lines()
                    .last()
                    .is_some_and(|line| line.contains(&psnr)),
                "{psnr}: {stdout}"
            );
            let names: Vec<_> = report["per_image"]
                .as_array()
                .expect("scores")
                .iter()
                .map(|image| &image["name"])
                .collect();
            assert_eq!(names, ["00.png", "08.png"]);
        }
    }
    assert!(folder.join("first one.spz").is_file());
    let mut view = Command::new("sh")
        .args(["-c", &format!("exec {} --listen 127.0.0.1:0", commands[0])])
        .current_dir(folder)
        .stdout(Stdio::piped())
        .spawn()
        .expect("sh starts");
    let mut line = String::new();
    BufReader::new(view.stdout.take().expect("piped"))
        .read_line(&mut line)
        .expect("stdout is read");
    assert!(
        line.starts_with("open http://127.0.0.1:") && line.ends_with("/ in a browser\n"),
        "{line}"
    );
    assert!(
        Command::new("sh")
            .args(["-c", &format!("kill -INT {}", view.id())])
            .status()
            .expect("sh starts")
            .success()
    );
    assert_eq!(view.wait().expect("it ends").code(), Some(0));

    let page =
        std::fs::read_to_string(folder.join("my runs/first one/report.html")).expect("a page");
    for words in [
        "00.png",
        "08.png",
        "<svg ",
        "my data",
        "eval &apos;my",
        "--scale",
    ] {
        let words = words.replace("&apos;", "'");
        assert!(page.contains(&words), "{words} is missing in the page");
    }
    let pictures: Vec<image::RgbImage> = page
        .split("data:image/jpeg;base64,")
        .skip(1)
        .map(|rest| rest.split('"').next().expect("a quoted address"))
        .map(|text| {
            image::load_from_memory(&bytes_from_base64(text))
                .expect("a JPEG")
                .into_rgb8()
        })
        .collect();
    // The first picture shows the whole model. The others are the image, render, error and depth of
    // both test images.
    let (overview, pictures) = pictures.split_first().expect("pictures");
    assert!(overview.width() > overview.height(), "an overview");
    assert!(page.contains("<svg class=\"coverage\""), "a map");
    assert_eq!(pictures.len(), 8);
    assert!(
        pictures
            .iter()
            .all(|picture| picture.dimensions() == (36, 27)),
        "photos of 48x36, shrunk"
    );
    // Each render shows its own test image, not the other one.
    let [difference_to_own, difference_to_other] =
        [0, 4].map(|ix| difference(&pictures[ix], &pictures[1]));
    assert!(
        difference_to_own < 0.7 * difference_to_other && brightness(&pictures[1]) > 30.0,
        "{difference_to_own} {difference_to_other}"
    );
    let others = page.replace("http://www.w3.org/2000/svg", "");
    assert!(
        !others.contains("http") && !others.contains("<script"),
        "the page needs no network"
    );
}

#[test]
fn report_without_test_images_says_so() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("data"), false, 0.0);
    train(
        folder,
        &[
            "data",
            "--steps",
            "1",
            "--max-splats",
            "500",
            "--out",
            "first",
        ],
    );
    let list = std::fs::read_to_string(folder.join("first/keyframes.txt")).expect("a list");
    std::fs::write(folder.join("list.txt"), list.replace(" test", " train"))
        .expect("the disk has space");
    let args = [
        "data",
        "--steps",
        "1",
        "--max-splats",
        "500",
        "--keyframes",
        "list.txt",
        "--out",
        "second",
    ];
    let printed = train(folder, &args);
    assert!(
        printed.contains(" view second") && !printed.contains(" eval "),
        "{printed}"
    );
    let page = std::fs::read_to_string(folder.join("second/report.html")).expect("a page");
    assert!(page.contains("there are no test images"), "{page}");
}

#[test]
fn unwritable_report_page_keeps_the_model() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("data"), false, 0.0);
    for file in ["report.html", "cameras.json"] {
        std::fs::create_dir_all(folder.join("model").join(file).join("in the way"))
            .expect("the disk has space");
    }
    let output = fieldrig(
        folder,
        &[
            "train",
            "data",
            "--steps",
            "1",
            "--max-splats",
            "500",
            "--out",
            "model",
            "--json",
        ],
    );
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{printed}");
    assert!(
        printed.contains("report.html was not") && printed.contains("cameras.json was not"),
        "{printed}"
    );
    assert!(
        folder.join("model/splats.ply").is_file() && folder.join("model/report.json").is_file()
    );
    assert!(
        !String::from_utf8_lossy(&output.stdout).contains(" view "),
        "commands are printed only without --json"
    );
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
    let group = |group: &[u8]| {
        let bits = group
            .iter()
            .fold(0, |bits, symbol| bits << 6 | sextet(*symbol))
            << (6 * (4 - group.len()));
        bits.to_be_bytes()[1..group.len()].to_vec()
    };
    symbols.chunks(4).flat_map(group).collect()
}
