//! Fuzz target for messages of recordings.

use super::input::take;
use crate::wire::{descriptor, foxglove, joint_state, point_cloud};

/// Reads one byte for the kind of message, then one message. Checks that readable messages survive
/// encoding and decoding.
pub fn messages(mut bytes: &[u8]) {
    let [kind] = take(&mut bytes);
    let assert_round_trip =
        |encoded: Vec<u8>, reencoded: Option<Vec<u8>>| assert_eq!(Some(encoded), reencoded);
    match kind % 8 {
        kind @ 0..2 => {
            let schema = [descriptor::COMPRESSED_IMAGE, descriptor::RAW_IMAGE][usize::from(kind)];
            let Ok(image) = foxglove::decode_image(schema.name, bytes) else {
                return;
            };
            let encoded = foxglove::encode_image(&image);
            let schema = foxglove::schema_of(image.format);
            let read = foxglove::decode_image(schema.name, &encoded).ok();
            assert_round_trip(encoded, read.map(|image| foxglove::encode_image(&image)));
        }
        2 => {
            let Ok((stamp, pose)) = foxglove::decode_transform(bytes) else {
                return;
            };
            let encoded = foxglove::encode_transform("a", "b", stamp, &pose);
            let read = foxglove::decode_transform(&encoded).ok();
            assert_round_trip(
                encoded,
                read.map(|(stamp, pose)| foxglove::encode_transform("a", "b", stamp, &pose)),
            );
        }
        3 => drop(foxglove::decode_true_pose(bytes)),
        4 => {
            if let Ok(depth_m) = foxglove::decode_depth_m(bytes) {
                assert!(4 * depth_m.len() <= bytes.len());
            }
        }
        5 => {
            let Ok(state) = joint_state::decode(bytes) else {
                return;
            };
            let encoded = joint_state::encode(&state);
            let read = joint_state::decode(&encoded).ok();
            assert_round_trip(encoded, read.map(|state| joint_state::encode(&state)));
        }
        _ => {
            let Ok(scan) = point_cloud::decode(bytes) else {
                return;
            };
            let encoded = point_cloud::encode(&scan);
            let read = point_cloud::decode(&encoded).ok();
            assert_round_trip(encoded, read.map(|scan| point_cloud::encode(&scan)));
        }
    }
}
