//! Checks that viewers get pictures of all models while models are saved and scored, and that this
//! does not change scores.

use super::*;
use crate::chunk_publisher::ChunkPublisher;
use crate::render_budget::RenderBudget;
use gpu::{GpuOptions, PassTiming};
use keyframe::Split;
use kinematics::Transform;
use serde_json::{Value, json};
use std::cell::RefCell;
use std::collections::BTreeSet;
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::rc::Rc;
use std::sync::{Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;
use trainer::{CorrectedKeyframe, Error, Method, PendingCheckpoint, Picture, RenderRequest};
use tungstenite::Message;
use viz::{Hub, Server, ServerConfig};

const N_TESTS: u8 = 4;
/// Size of the test images.
const TEST_PX: [u32; 2] = [4, 2];
/// Size of the pictures that the client requests.
const CLIENT_PX: [u32; 2] = [8, 8];
/// Far more than a client on a busy computer needs for a request.
const TIMEOUT: Duration = Duration::from_secs(120);
const METHODS: [&str; 2] = ["splat", "tsdf"];

/// A gray model. While it is viewed, it draws a test image only after a client has requested a
/// picture, so that requests are pending between all images. It also draws every test image after
/// the first only after the client has received the progress of scoring.
struct Gray {
    name: &'static str,
    level: u8,
    viewed: Option<(Hub, Received)>,
    drawn: DrawnSizes,
}

/// The methods of the pictures and the states that the client has received.
type Received = Arc<(Mutex<BTreeSet<String>>, Condvar)>;

/// The method and the size of each picture, in the order of drawing.
type DrawnSizes = Rc<RefCell<Vec<(&'static str, [u32; 2])>>>;

impl Method for Gray {
    fn push(&mut self, _keyframe: Arc<Keyframe>) -> Result<(), Error> {
        Ok(())
    }

    fn remove(&mut self, _camera: &str, _stamp: Stamp) -> Result<(), Error> {
        Ok(())
    }

    fn step(&mut self, _n: u64) -> Result<u64, Error> {
        panic!("a model that is saved must not be trained")
    }

    fn is_idle(&self) -> bool {
        true
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        Ok(1)
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        if let Some((hub, received)) = &self.viewed
            && request.size_px == TEST_PX
        {
            assert!(hub.pictures().wait_for_request(TIMEOUT), "no request");
            let is_first = !self
                .drawn
                .borrow()
                .iter()
                .any(|(_, size_px)| *size_px == TEST_PX);
            assert!(is_first || waits_for_scoring(received), "no progress");
        }
        self.drawn.borrow_mut().push((self.name, request.size_px));
        let n = request.size_px[0] as usize * request.size_px[1] as usize;
        Ok(Picture {
            size_px: request.size_px,
            rgba_srgb: vec![self.level; 4 * n],
            depth_m: vec![0.0; if request.depth { n } else { 0 }],
        })
    }

    fn recalibrate(&mut self, _: &[CorrectedKeyframe], _: &Alignment) -> Result<(), Error> {
        Ok(())
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        Ok(Vec::new())
    }

    fn progress(&self) -> Progress {
        Progress {
            step: 1,
            primitives: 1,
            ..Progress::default()
        }
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        std::fs::create_dir_all(folder).expect("the disk has space");
        std::fs::write(folder.join("splats.ply"), [self.level]).expect("the disk has space");
        Ok(())
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        Err(Error::AllPixelsMasked)
    }
}

fn test_keyframe(ix: u8) -> Arc<Keyframe> {
    Arc::new(Keyframe {
        camera: "wrist".into(),
        stamp: Stamp(ix.into()),
        size_px: TEST_PX,
        focal_px: [4.0; 2],
        principal_px: [2.0, 1.0],
        rgba_srgb: [100 + 10 * ix, 50, 50, 255].repeat(8).into(),
        depth: None,
        world_from_camera: Transform::identity(),
        twist: None,
        readout_secs: 0.0,
        joint_twists: [].into(),
        base: None,
        split: Split::Test,
        truth: None,
        robot: None,
    })
}

/// A trained session of each method, to be saved in folders of their own.
fn endings(
    folder: &Path,
    viewed: Option<&(Hub, Received)>,
    drawn: &DrawnSizes,
) -> Vec<EndingSession<Value>> {
    let gpu = Gpu::open(&GpuOptions::default()).expect("an adapter");
    let kind = |name: &str| {
        let mut all = ModelKind::ALL.iter();
        *all.find(|kind| kind.name() == name).expect("a method")
    };
    let ending = |(name, level): (&'static str, u8)| {
        let method = Gray {
            name,
            level,
            viewed: viewed.cloned(),
            drawn: Rc::clone(drawn),
        };
        let evaluators = Evaluators {
            during_training: Evaluator::psnr_only(),
            max_images_during_training: 1,
            max_frac_during_training: None,
            at_end: Evaluator::psnr_only(),
        };
        let mut session = Session::new(
            gpu.clone(),
            (kind(name), AlignedModel::unaligned(Box::new(method))),
            SessionOptions::new(evaluators, Limits::default(), Box::new(())),
        );
        for ix in 0..N_TESTS {
            session.push(&test_keyframe(ix)).expect("held");
        }
        let out = folder.join(name);
        std::fs::create_dir_all(&out).expect("the disk has space");
        EndingSession {
            session,
            out,
            details: Value::Null,
        }
    };
    METHODS.into_iter().zip([90, 130]).map(ending).collect()
}

/// A client that requests pictures of both methods in turn until the server stops. After each
/// picture, it connects again, like a page that is reloaded.
fn client(address: SocketAddr, received: Received) -> JoinHandle<()> {
    std::thread::spawn(move || {
        let add = |text: Option<String>| {
            received.0.lock().expect("no panic").extend(text);
            received.1.notify_all();
        };
        for method in METHODS.into_iter().cycle() {
            let Ok(stream) = TcpStream::connect(address) else {
                break;
            };
            let Ok((mut socket, _)) = tungstenite::client(format!("ws://{address}/ws"), stream)
            else {
                break;
            };
            let request = json!({
                "type": "render", "id": 1, "method": method, "size_px": CLIENT_PX, "stages": [1],
                "world_from_camera": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
                "projection": {"kind": "pinhole", "focal_px": [8, 8]},
            });
            let is_sent = socket.send(Message::text(request.to_string())).is_ok();
            let mut has_picture = false;
            let mut has_state = false;
            while is_sent
                && !(has_picture && has_state)
                && let Ok(message) = socket.read()
            {
                match message {
                    Message::Binary(bytes) if contains(&bytes, br#""type":"picture""#) => {
                        add(Some(method.to_owned()));
                        has_picture = true;
                    }
                    Message::Text(text) => {
                        let state = state_in(&text);
                        has_state |= state.is_some();
                        add(state);
                    }
                    _ => {}
                }
            }
        }
    })
}

/// Waits until the client has received how many test images are scored.
fn waits_for_scoring((received, changed): &(Mutex<BTreeSet<String>>, Condvar)) -> bool {
    let guard = received.lock().expect("no panic");
    let is_missing =
        |received: &mut BTreeSet<String>| !received.iter().any(|state| is_scoring(state));
    let (_guard, waited) = changed
        .wait_timeout_while(guard, TIMEOUT, is_missing)
        .expect("no panic");
    !waited.timed_out()
}

fn is_scoring(state: &str) -> bool {
    state.starts_with("scoring, ") && state.contains(" of 4 ")
}

/// The state in a message, if it is a status.
fn state_in(text: &str) -> Option<String> {
    let message: Value = serde_json::from_str(text).expect("JSON");
    assert_ne!(message["type"], "error", "{message}");
    (message["type"] == "status").then(|| message["state"].as_str().expect("a string").to_owned())
}

fn contains(bytes: &[u8], part: &[u8]) -> bool {
    bytes.windows(part.len()).any(|window| window == part)
}

#[test]
fn viewers_get_pictures_of_all_models_while_each_is_scored() {
    let folder = tempfile::tempdir().expect("a folder");
    let drawn = DrawnSizes::default();
    let unwatched = finish(
        endings(&folder.path().join("unwatched"), None, &drawn),
        None,
    )
    .expect("scored");
    drawn.borrow_mut().clear();

    let hub = Hub::new();
    let server = Server::start(
        ServerConfig {
            listen: ([127, 0, 0, 1], 0).into(),
        },
        hub.clone(),
    )
    .expect("a free port");
    let received = Received::default();
    let client = client(server.address(), Arc::clone(&received));
    let chunks = ChunkPublisher::new(hub.clone());
    let mut viewers = EndViewers::new(hub.clone(), RenderBudget::new(true), chunks);
    let watched = finish(
        endings(
            &folder.path().join("watched"),
            Some(&(hub.clone(), Arc::clone(&received))),
            &drawn,
        ),
        Some(&mut viewers),
    )
    .expect("scored");
    drop(server);
    client.join().expect("no panic");
    let received = received.0.lock().expect("no panic");

    let results = |models: &[FinishedModel]| -> Vec<_> {
        let result = |model: &FinishedModel| {
            let saved = std::fs::read(model.folder.join("splats.ply")).expect("saved");
            (model.kind, model.scores.clone(), saved)
        };
        models.iter().map(result).collect()
    };
    assert!(
        results(&watched) == results(&unwatched),
        "the results differ"
    );
    assert_eq!(watched.len(), METHODS.len());
    let drawn = drawn.borrow();
    let is_test = |(_, size_px): &(_, [u32; 2])| *size_px == TEST_PX;
    let first = drawn.iter().position(is_test).expect("scored");
    let last = drawn.iter().rposition(is_test).expect("scored");
    let while_scoring: BTreeSet<&str> = drawn[first..last]
        .iter()
        .filter(|drawn| !is_test(drawn))
        .map(|(method, _)| *method)
        .collect();
    assert_eq!(
        while_scoring,
        METHODS.into(),
        "pictures of both models are drawn between the scored images"
    );
    assert!(
        METHODS.iter().all(|method| received.contains(*method)),
        "{received:?}"
    );
}
