//! Receives models in chunks from the real server.

use crate::client::TIMEOUT;
use crate::client::{Client, Received};
use crate::local_server::start;
use crate::models;
use crate::models::{ModelThread, splat_model, tsdf_model, wall};
use crate::proxy::{Link, Proxy};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{ChunkLayout, Method, ModelChunks};

const SUBSCRIPTION: [&str; 3] = ["subscribe", "parts", "model_chunks"];

/// A client's chunks by id: whether it is coarse, and the payload.
#[derive(Default)]
struct Replica {
    chunks: BTreeMap<u64, (Value, Vec<u8>)>,
    n_bytes: usize,
    n_coarse: usize,
    n_incomplete: Option<u64>,
}

impl Replica {
    fn apply(&mut self, received: Received) {
        match received {
            Received::Binary(header, payload) if header["type"] == "model_chunk" => {
                self.n_bytes += payload.len();
                self.n_coarse += usize::from(header["is_coarse"] == true);
                self.n_incomplete = header["n_incomplete"].as_u64();
                self.chunks
                    .insert(header["id"].as_u64().expect("an id"), (header, payload));
            }
            Received::Text(message) if message["type"] == "model_chunks_removed" => {
                for id in message["ids"].as_array().expect("a list") {
                    self.chunks.remove(&id.as_u64().expect("an id"));
                }
            }
            Received::Text(message) if message["type"] == "error" => panic!("{message}"),
            Received::End => panic!("disconnected"),
            _ => {}
        }
    }

    fn receive_all(&mut self, client: &mut Client) {
        self.n_incomplete = None;
        while self.n_incomplete != Some(0) {
            self.apply(client.receive());
        }
    }

    fn assert_equals(&self, expected: &ModelChunks) {
        assert_eq!(self.chunks.len(), expected.chunks.len());
        for chunk in &expected.chunks {
            let (header, payload) = &self.chunks[&chunk.id];
            assert!(
                header["is_coarse"] == false && *payload == chunk.fine.bytes,
                "chunk {}",
                chunk.id
            );
            match chunk.fine.layout {
                ChunkLayout::Mesh { n_vertices, .. } => {
                    assert_eq!(header["n_vertices"], n_vertices)
                }
                ChunkLayout::Splats { n_splats, .. } => assert_eq!(header["n_splats"], n_splats),
            }
        }
    }
}

fn connect(address: SocketAddr) -> Client {
    let mut client = Client::connect(address);
    client.send_json(&json!({"type": "hello", "protocols": [3, 4], "capabilities": SUBSCRIPTION}));
    assert_eq!(
        client.text_of("welcome")["capabilities"],
        json!(["subscribe", "parts", "model_chunks"])
    );
    client
}

fn subscribe(client: &mut Client, method: &str) {
    client.send_json(
        &json!({"type": "subscribe", "topic": "model_chunks", "rate_hz": 2, "method": method}),
    );
}

fn all_chunks(model: &mut dyn Method) -> ModelChunks {
    model
        .queue_chunks(false, &Arc::default())
        .expect("queued")
        .expect("not empty")
        .finish()
        .expect("encoded")
}

#[test]
fn a_client_receives_both_kinds_of_models_in_full() {
    let (hub, server) = start();
    let mut splats = splat_model(&wall(20_000));
    let mut tsdf = tsdf_model(6);
    let expected = [all_chunks(&mut splats), all_chunks(&mut tsdf)];
    let models: models::Models = vec![("splat", Box::new(splats)), ("tsdf", Box::new(tsdf))];
    let thread = ModelThread::start(hub.clone(), models);
    let mut client = connect(server.address());
    for (method, expected) in ["splat", "tsdf"].into_iter().zip(&expected) {
        subscribe(&mut client, method);
        let mut replica = Replica::default();
        replica.receive_all(&mut client);
        replica.assert_equals(expected);
        assert!(
            replica
                .chunks
                .values()
                .all(|(header, _)| header["method"] == method)
        );
        assert_eq!(replica.n_coarse > 0, method == "splat");
    }
    assert!(hub.model_chunks().contains("tsdf") && !hub.model_chunks().contains("splat"));
    client.send_json(&json!({"type": "subscribe", "topic": "model_chunks", "rate_hz": 0}));
    client.settle();
    assert!(
        !hub.model_chunks().contains("tsdf") && hub.model_chunks().period("tsdf").is_none(),
        "the memory is free"
    );
    drop(thread.finish());
}

/// Distance from a position to the center of a chunk of splats.
fn distance(header: &Value, from: [f64; 3]) -> f64 {
    let corner = |name: &str, axis: usize| header[name][axis].as_f64().expect("a coordinate");
    let offset = |axis| 0.5 * (corner("min_m", axis) + corner("max_m", axis)) - from[axis];
    [0, 1, 2]
        .map(offset)
        .iter()
        .map(|along| along * along)
        .sum::<f64>()
        .sqrt()
}

#[test]
fn chunks_near_the_requested_view_come_first() {
    let (hub, server) = start();
    let thread = ModelThread::start(hub, vec![("splat", Box::new(splat_model(&wall(60_000))))]);
    let mut client = connect(server.address());
    let eye = [1.8, -0.4, 1.2];
    // Looks along y; the wide view contains the whole wall.
    let pose = [
        1.0, 0.0, 0.0, eye[0], 0.0, 0.0, 1.0, eye[1], 0.0, -1.0, 0.0, eye[2], 0.0, 0.0, 0.0, 1.0,
    ];
    client.send_json(&json!({
        "type": "render", "id": 1, "world_from_camera": pose, "size_px": [32, 32],
        "projection": {"kind": "pinhole", "vertical_fov_rad": 3.1},
    }));
    subscribe(&mut client, "splat");
    // Ids in the order of their arrival, coarse and in full, and distances of the chunks in full.
    let mut ids: [Vec<u64>; 2] = Default::default();
    let mut distances = BTreeMap::new();
    let mut n_incomplete = None;
    while n_incomplete != Some(0) {
        let Received::Binary(header, _) = client.receive() else {
            continue;
        };
        if header["type"] == "model_chunk" {
            n_incomplete = header["n_incomplete"].as_u64();
            let (id, is_fine) = (
                header["id"].as_u64().expect("an id"),
                header["is_coarse"] == false,
            );
            ids[usize::from(is_fine)].push(id);
            if is_fine {
                distances.insert(id, distance(&header, eye));
            }
        }
    }
    for ids in &ids {
        let distances: Vec<_> = ids.iter().map(|id| distances[id]).collect();
        assert!(distances.len() > 3, "{distances:?}");
        assert!(distances.is_sorted(), "{distances:?}");
    }
    drop(thread.finish());
}

#[test]
fn changes_arrive_and_the_copy_equals_the_model() {
    let (hub, server) = start();
    let mut client = connect(server.address());
    subscribe(&mut client, "tsdf");
    client.settle();
    let mut replica = Replica::default();
    let mut model = tsdf_model(2);
    hub.model_chunks().set(
        "tsdf",
        model
            .queue_chunks(true, &Arc::default())
            .expect("queued")
            .expect("chunks")
            .finish()
            .expect("encoded"),
    );
    replica.receive_all(&mut client);
    let n_first = replica.chunks.len();
    let publisher = std::thread::spawn(move || {
        for keyframe in
            keyframe::scenes::ring(&[keyframe::scenes::floor()], nalgebra::Point3::origin(), 12)
        {
            model.push(keyframe).expect("a keyframe");
            while !model.is_idle() {
                model.step(1).expect("fused");
            }
            let changes = model
                .queue_chunks(true, &Arc::default())
                .expect("queued")
                .expect("chunks")
                .finish()
                .expect("encoded");
            assert!(!changes.is_complete);
            hub.model_chunks().set("tsdf", changes);
        }
        all_chunks(&mut model)
    });
    while !publisher.is_finished() {
        replica.apply(client.receive());
    }
    let expected = publisher.join().expect("no panic");
    assert_ne!(expected.chunks.len(), n_first);
    let is_equal = |replica: &Replica| {
        replica.chunks.len() == expected.chunks.len()
            && expected.chunks.iter().all(|chunk| {
                replica
                    .chunks
                    .get(&chunk.id)
                    .is_some_and(|(_, payload)| *payload == chunk.fine.bytes)
            })
    };
    let began = Instant::now();
    while !is_equal(&replica) {
        assert!(
            began.elapsed() < TIMEOUT,
            "{} of {} chunks",
            replica.chunks.len(),
            expected.chunks.len()
        );
        replica.apply(client.receive());
    }
}

/// On a link of 20 Mbit/s, pictures and replies do not wait for the model, which takes 2 s. Counts
/// bytes instead of time, because the computer may be busy.
#[test]
fn models_do_not_delay_other_messages() {
    const LINK: Link = Link {
        bytes_per_sec: 2.5e6,
        delay: Duration::ZERO,
        slow_period: usize::MAX,
        slow_delay: Duration::ZERO,
    };
    /// What the server sends before a reply that it has not yet handed to the kernel, and what the
    /// link and both ends hold: measured 0.6 to 0.8 MB.
    const MAX_BYTES_BEFORE_REPLY: usize = 1_500_000;
    /// If the server paused between chunks, the link would be empty when most pings arrive.
    const MIN_MEAN_BYTES_BEFORE_REPLY: usize = 100_000;
    let (hub, server) = start();
    let thread = ModelThread::start(hub, vec![("splat", Box::new(splat_model(&wall(150_000))))]);
    let proxy = Proxy::start(server.address(), LINK);
    let mut client = connect(proxy.address());
    subscribe(&mut client, "splat");
    let mut replica = Replica::default();
    while replica.chunks.is_empty() {
        replica.apply(client.receive());
    }
    let n_first = client.n_received();
    let (mut n_arrived_at_ping, mut n_before_replies) = (None, Vec::new());
    let mut n_coarse = None;
    while replica.n_incomplete != Some(0) {
        if n_arrived_at_ping.is_none() {
            n_arrived_at_ping = Some(client.n_arrived());
            client.send_json(&json!({"type": "ping", "t": 1}));
        }
        let received = client.receive();
        if matches!(&received, Received::Text(message) if message["type"] == "pong") {
            n_before_replies.extend(
                n_arrived_at_ping
                    .take()
                    .map(|n| client.n_received().saturating_sub(n)),
            );
        }
        replica.apply(received);
        let has_fine = replica
            .chunks
            .values()
            .any(|(header, _)| header["is_coarse"] == false);
        if has_fine && n_coarse.is_none() {
            n_coarse = Some(client.n_received() - n_first);
        }
    }
    let n_bytes = client.n_received() - n_first;
    eprintln!("{n_bytes} bytes, {n_coarse:?} of them coarse, before replies {n_before_replies:?}");
    assert!(
        n_bytes > 3 * MAX_BYTES_BEFORE_REPLY && n_before_replies.len() > 2,
        "{n_bytes}: {n_before_replies:?}"
    );
    assert!(
        n_coarse.is_some_and(|n_coarse| 10 * n_coarse < 3 * n_bytes),
        "{n_coarse:?} of {n_bytes} bytes"
    );
    let most = n_before_replies.iter().max().expect("replies");
    assert!(
        *most < MAX_BYTES_BEFORE_REPLY,
        "{most} bytes were sent before a reply: {n_before_replies:?}"
    );
    let mean = n_before_replies.iter().sum::<usize>() / n_before_replies.len();
    assert!(
        mean > MIN_MEAN_BYTES_BEFORE_REPLY,
        "the link is not used: {n_before_replies:?} bytes before replies"
    );
    drop(thread.finish());
}
