//! Tests the times of keyframes in pictures, and reports of shown pictures, over a real connection.

use crate::client::Client;
use crate::client::TIMEOUT;
use crate::local_server::serve;
use serde_json::{Value, json};
use std::time::{Duration, Instant};
use viz::{Hub, NewestKeyframe, TrainedKeyframes};

/// Age of a keyframe when it is drawn, and time since it was added to the model.
const AGE: Duration = Duration::from_millis(300);
const SINCE_ADDED: Duration = Duration::from_millis(100);

/// Requests a picture and draws it.
fn draw(hub: &Hub, client: &mut Client, id: u64, trained_on: Option<TrainedKeyframes>) -> Value {
    client.send_json(&json!({
        "type": "render", "id": id, "view": "inset", "size_px": [80, 60], "stages": [1.0],
        "world_from_camera": [1, 0, 0, 0.0, 0, 0, 1, -2.0, 0, -1, 0, 0.5, 0, 0, 0, 1],
        "projection": {"kind": "pinhole", "vertical_fov_rad": 0.9},
    }));
    assert!(
        hub.pictures().wait_for_request(TIMEOUT),
        "no request arrived"
    );
    let pending = hub.pictures().next_request().expect("a request is pending");
    let picture = analytic_scene::draw(&pending.request);
    match trained_on {
        Some(trained_on) => pending.of_keyframes(trained_on).deliver(picture),
        None => pending.deliver(picture),
    }
    client.binary_of("picture").0
}

fn trained_on(n: u64) -> Option<TrainedKeyframes> {
    let before = |age: Duration| {
        Instant::now()
            .checked_sub(age)
            .expect("the machine has run for longer")
    };
    let newest = NewestKeyframe {
        captured_at: before(AGE),
        added_at: before(SINCE_ADDED),
    };
    Some(TrainedKeyframes {
        n,
        newest: Some(newest),
    })
}

#[test]
fn pictures_have_the_times_of_their_newest_keyframe() {
    let hub = Hub::new();
    let server = serve(&hub);
    let mut client = Client::connect(server.address());
    let before_millis = client.text_of("hello")["clock_millis"]
        .as_f64()
        .expect("a time");
    let without = draw(&hub, &mut client, 1, None);
    assert_eq!(
        [&without["keyframes"], &without["newest_keyframe"]],
        [&Value::Null; 2]
    );
    let before_keyframes = draw(
        &hub,
        &mut client,
        2,
        Some(TrainedKeyframes { n: 0, newest: None }),
    );
    assert_eq!(
        [
            &before_keyframes["keyframes"],
            &before_keyframes["newest_keyframe"]
        ],
        [&json!(0), &Value::Null]
    );
    let header = draw(&hub, &mut client, 3, trained_on(7));
    client.send_json(&json!({"type": "ping", "t": 0}));
    let after_millis = client.text_of("pong")["clock_millis"]
        .as_f64()
        .expect("a time");
    let millis = |value: &Value| {
        value
            .as_f64()
            .unwrap_or_else(|| panic!("no time in {header}"))
    };
    let sent = millis(&header["sent_millis"]);
    let [captured, added] =
        ["captured_millis", "added_millis"].map(|name| millis(&header["newest_keyframe"][name]));
    assert!(before_millis < sent && sent < after_millis, "{header}");
    assert!(
        ((added - captured) - (AGE - SINCE_ADDED).as_secs_f64() * 1e3).abs() < 1.0,
        "{header}"
    );
    let elapsed = after_millis - before_millis;
    assert!(
        (sent - added - SINCE_ADDED.as_secs_f64() * 1e3) < elapsed && sent - added >= 100.0,
        "{header}"
    );
}

#[test]
fn shown_pictures_reach_the_run() {
    let hub = Hub::new();
    let server = serve(&hub);
    let mut client = Client::connect(server.address());
    let capabilities = client.text_of("hello")["capabilities"].clone();
    assert!(
        capabilities
            .as_array()
            .is_some_and(|names| names.contains(&json!("shown"))),
        "{capabilities}"
    );
    let shown = |id: u64, millis: f64| json!({"type": "shown", "id": id, "view": "inset", "shown_millis": millis});
    let mut sent_millis = Vec::new();
    for (id, n_keyframes) in [(1, 40), (2, 42), (3, 43)] {
        let header = draw(&hub, &mut client, id, trained_on(n_keyframes));
        sent_millis.push(header["sent_millis"].as_f64().expect("a time"));
    }
    draw(&hub, &mut client, 4, None);
    std::thread::sleep(Duration::from_millis(30));
    for (id, millis) in [
        (2, sent_millis[1] + 12.5),
        (3, 0.0),
        (3, 1.0),
        (4, 5.0),
        (99, 5.0),
    ] {
        client.send_json(&shown(id, millis));
    }
    client.settle();
    let pictures = hub.pictures().take_shown();
    assert_eq!(
        pictures.len(),
        2,
        "each once, and only pictures of a model in training: {pictures:?}"
    );
    assert_eq!(
        [&pictures[0].new_keyframes, &pictures[1].new_keyframes],
        [&(40..42), &(42..43)]
    );
    let showing = pictures[0].shown_at - pictures[0].sent_at;
    assert!(
        (showing.as_secs_f64() * 1e3 - 12.5).abs() < 0.1,
        "{showing:?}"
    );
    assert_eq!(
        pictures[1].shown_at, pictures[1].sent_at,
        "not before it was sent"
    );
    assert_eq!(hub.pictures().take_shown(), [], "taken");

    client.send_json(&shown(1, -1.0));
    let refusal = client.text_of("error");
    assert_eq!(refusal["id"], json!(1));
    assert!(
        refusal["message"]
            .as_str()
            .is_some_and(|text| text.contains("shown_millis is -1")),
        "{refusal}"
    );
}
