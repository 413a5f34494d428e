//! Requests photographs of keyframes from the real server, and compares them with the keyframes.

use crate::client::{Client, part};
use crate::local_server::start;
use flate2::read::ZlibDecoder;
use keyframe::{Keyframe, Split};
use kinematics::{Stamp, Transform, Twist};
use nalgebra::{Translation3, Vector3};
use serde_json::{Value, json};
use std::io::Read;

use std::sync::Arc;
use viz::{KeyframePose, Server};

const SIZE_PX: [u32; 2] = [64, 48];
/// Maximum mean difference of a photograph from the keyframe, of 255: JPEG with high quality.
const MAX_DIFFERENCE: f64 = 3.0;

/// Red increases along x, green along y. The pixels of the first column are masked.
fn photographed(stamp_nanos: i64) -> Keyframe {
    let [width, height] = SIZE_PX;
    let channel = |value: u32| u8::try_from(value).expect("below 256");
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    Keyframe {
        camera: "wrist".into(),
        stamp: Stamp(stamp_nanos),
        size_px: SIZE_PX,
        focal_px: [60.0; 2],
        principal_px: [32.0, 24.0],
        rgba_srgb: pixels
            .flat_map(|(x, y)| {
                let alpha = if x == 0 { 0 } else { 255 };
                [channel(3 * x), channel(4 * y), 40, alpha]
            })
            .collect(),
        depth: None,
        world_from_camera: Translation3::new(0.1, 0.2, 0.3).into(),
        twist: Some(Twist {
            linear_m_s: Vector3::new(0.0, 0.3, 0.4),
            angular_rad_s: Vector3::new(0.2, 0.0, 0.0),
        }),
        readout_secs: 0.015,
        joint_twists: [].into(),
        base: None,
        split: Split::Validation,
        truth: None,
        robot: None,
    }
}

/// Its entry in the list, with a correction of 5 mm.
fn listed(keyframe: &Keyframe) -> KeyframePose {
    let correction: Transform = Translation3::new(0.0, 0.0, 0.005).into();
    KeyframePose {
        camera: Arc::clone(&keyframe.camera),
        stamp: keyframe.stamp,
        world_from_camera: keyframe.world_from_camera * correction,
        size_px: keyframe.size_px,
        focal_px: keyframe.focal_px,
        principal_px: keyframe.principal_px,
    }
}

/// A client that receives changes of the list, and the list.
fn connect(server: &Server) -> (Client, Vec<Value>) {
    let mut client = Client::connect(server.address());
    let hello = client.text_of("hello");
    let has_capability = |name: &Value| name == "keyframe_images";
    let capabilities = hello["capabilities"].as_array().expect("a list");
    assert!(capabilities.iter().any(has_capability), "{hello}");
    client.send_json(&json!({
        "type": "hello", "protocols": [3, 4],
        "capabilities": ["keyframe_changes", "keyframe_images", "parts"],
    }));
    let changes = client.text_of("keyframe_changes");
    let keyframes = changes["keyframes"].as_array().expect("a list").clone();
    (client, keyframes)
}

/// Mean difference between a JPEG file and pixels that are a function of the position.
fn mean_difference(jpeg: &[u8], expected: impl Fn(u32, u32) -> [f64; 3]) -> f64 {
    let image = image::load_from_memory_with_format(jpeg, image::ImageFormat::Jpeg);
    let image = image.expect("a JPEG file").into_rgb8();
    let differences = image.enumerate_pixels().flat_map(|(x, y, pixel)| {
        let expected = expected(x, y);
        (0..3).map(move |channel| (f64::from(pixel.0[channel]) - expected[channel]).abs())
    });
    differences.sum::<f64>() / f64::from(3 * image.width() * image.height())
}

fn inflated(bytes: &[u8]) -> Vec<u8> {
    let mut inflated = Vec::new();
    let read = ZlibDecoder::new(bytes).read_to_end(&mut inflated);
    read.expect("a zlib stream");
    inflated
}

/// The header of a photograph.
pub(crate) fn header_of_photograph() -> Value {
    let (hub, server) = start();
    let keyframe = Arc::new(photographed(7));
    hub.keyframes().set_sources([&keyframe]);
    hub.keyframes().set(vec![listed(&keyframe)]);
    let (mut client, keyframes) = connect(&server);
    let number = &keyframes[0]["id"];
    client.send_json(&json!({"type": "keyframe_image", "id": 5, "keyframe": number}));
    client.binary_of("keyframe_image").0
}

#[test]
fn clients_get_the_photograph_of_a_keyframe_with_its_mask_and_facts() {
    let (hub, server) = start();
    let keyframe = Arc::new(photographed(7));
    hub.keyframes().set_sources([&keyframe]);
    hub.keyframes().set(vec![listed(&keyframe)]);
    let (mut client, keyframes) = connect(&server);
    let number = &keyframes[0]["id"];

    client.send_json(&json!({"type": "keyframe_image", "id": 5, "keyframe": number}));
    let (header, payload) = client.binary_of("keyframe_image");
    assert_eq!((&header["id"], &header["keyframe"]), (&json!(5), number));
    assert_eq!(header["size_px"], json!(SIZE_PX));
    assert_eq!(
        (&header["camera"], &header["stamp_nanos"], &header["split"]),
        (&json!("wrist"), &json!(7), &json!("validation"))
    );
    assert_eq!(
        (&header["speed_m_s"], &header["turn_rad_s"]),
        (&json!(0.5), &json!(0.2))
    );
    // The pose in the list is the corrected one.
    assert_eq!(header["reported_world_from_camera"][11], json!(0.3));
    assert!((keyframes[0]["world_from_camera"][11].as_f64().expect("z") - 0.305).abs() < 1e-9);
    let full = |x, y| [f64::from(3 * x), f64::from(4 * y), 40.0];
    let difference = mean_difference(part(&header, "color", &payload), full);
    assert!(difference < MAX_DIFFERENCE, "{difference}");
    let mirrored = |x, y| full(SIZE_PX[0] - 1 - x, y);
    let difference = mean_difference(part(&header, "color", &payload), mirrored);
    assert!(difference > 5.0 * MAX_DIFFERENCE, "{difference}");
    let mask = inflated(part(&header, "mask", &payload));
    let is_valid = |ix: usize| !ix.is_multiple_of(SIZE_PX[0] as usize);
    let expected: Vec<u8> = (0..mask.len())
        .map(|ix| if is_valid(ix) { 255 } else { 0 })
        .collect();
    assert_eq!(mask.len(), 64 * 48);
    assert!(mask == expected, "only the first column is masked");

    client.send_json(
        &json!({"type": "keyframe_image", "id": 6, "keyframe": number, "size_px": [32, 1000]}),
    );
    let (header, payload) = client.binary_of("keyframe_image");
    assert_eq!(
        (&header["size_px"], &header["full_size_px"]),
        (&json!([32, 24]), &json!(SIZE_PX))
    );
    let halved = |x, y| [f64::from(6 * x) + 1.5, f64::from(8 * y) + 2.0, 40.0];
    let difference = mean_difference(part(&header, "color", &payload), halved);
    assert!(difference < MAX_DIFFERENCE, "{difference}");
}

#[test]
fn keyframes_that_are_not_in_memory_are_read_or_reported() {
    let (hub, server) = start();
    hub.keyframes()
        .set([7, 8].map(|stamp| listed(&photographed(stamp))).into());
    let (mut client, keyframes) = connect(&server);
    let request = |number: &Value| json!({"type": "keyframe_image", "id": 1, "keyframe": number});
    let stored = request(&keyframes[0]["id"]);
    client.send_json(&stored);
    let error = client.text_of("error");
    assert_eq!(error["keyframe"], keyframes[0]["id"]);
    let text = error["message"].as_str().expect("a text");
    assert!(text.contains("not stored"), "{error}");

    hub.keyframes()
        .set_reader(Arc::new(|camera: &str, stamp: Stamp| {
            assert_eq!(camera, "wrist");
            Ok((stamp == Stamp(7)).then(|| photographed(7)))
        }));
    client.send_json(&stored);
    let (header, _) = client.binary_of("keyframe_image");
    assert_eq!(header["stamp_nanos"], json!(7));
    client.send_json(&request(&keyframes[1]["id"]));
    let error = client.text_of("error");
    assert_eq!(error["keyframe"], keyframes[1]["id"]);

    client.send_json(&request(&json!(999)));
    let error = client.text_of("error");
    assert_eq!((&error["id"], &error["keyframe"]), (&json!(1), &json!(999)));
    let text = error["message"].as_str().expect("a text");
    assert!(text.contains("no keyframe with the number 999"), "{error}");
    client.send_json(&json!({"type": "keyframe_image", "id": 2, "keyframe": 1, "size_px": [2, 2]}));
    let error = client.text_of("error");
    assert!(
        error.get("keyframe").is_none() && error["id"] == 2,
        "{error}"
    );
}

/// Photographs are requested one at a time; a client that does not wait learns it, and gets the
/// first one.
#[test]
fn a_client_gets_one_photograph_at_a_time() {
    let (hub, server) = start();
    hub.keyframes().set(vec![listed(&photographed(7))]);
    let (release, released) = std::sync::mpsc::sync_channel::<()>(1);
    let released = std::sync::Mutex::new(released);
    hub.keyframes()
        .set_reader(Arc::new(move |_: &str, _: Stamp| {
            // Returns when the test allows it, or has failed.
            let _ = released.lock().expect("no panic").recv();
            Ok(Some(photographed(7)))
        }));
    let (mut client, keyframes) = connect(&server);
    let number = &keyframes[0]["id"];
    for id in [1, 2] {
        client.send_json(&json!({"type": "keyframe_image", "id": id, "keyframe": number}));
    }
    let error = client.text_of("error");
    assert_eq!((&error["id"], &error["keyframe"]), (&json!(2), number));
    release.send(()).expect("the reader waits");
    let (header, _) = client.binary_of("keyframe_image");
    assert_eq!(header["id"], json!(1));
}
