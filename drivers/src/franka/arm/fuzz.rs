//! Fuzz target: arbitrary state datagrams.

use super::{MAX_STATE_BYTES, StateQueue, StateReader, decode};
use crate::fuzz::input::take;
use franka::FciVersion;
use kinematics::Stamp;
use std::time::Duration;

/// Arrival time of the first datagram.
const START_TIME: Stamp = Stamp(1_000_000_000_000);
/// Maximum angle of any joint, rad.
const MAX_RAD: f64 = 10.0;
/// All versions that are read.
pub(crate) const VERSIONS: [FciVersion; 2] = [FciVersion::V5, FciVersion::V10];

/// Decodes concatenated datagrams, a millisecond apart. Each is preceded by its length in two
/// bytes, little-endian. Each datagram is decoded in both FCI versions, both unchanged and padded
/// to the length of a state.
///
/// Checks that the stamps of the resulting states increase and that their positions are plausible
/// angles.
pub fn states(bytes: &[u8]) {
    for version in VERSIONS {
        decode_positions(version, bytes);
    }
}

/// Positions of all joints in the states that an arm would return for the datagrams, see
/// [`states`].
pub(crate) fn decode_positions(version: FciVersion, mut bytes: &[u8]) -> Vec<Vec<f64>> {
    let mut reader = StateReader::new("it".to_owned(), version, None);
    let mut state_queue = StateQueue::default();
    let mut at = START_TIME;
    while !bytes.is_empty() {
        let n_bytes = usize::from(u16::from_le_bytes(take(&mut bytes)))
            .min(MAX_STATE_BYTES)
            .min(bytes.len());
        let (datagram, rest) = bytes.split_at(n_bytes);
        bytes = rest;
        let mut padded = datagram.to_vec();
        // States are longer than most fuzzing input. Padding lets short inputs get past the check
        // of the length.
        padded.resize(super::super::state::n_bytes(version), 0);
        for datagram in [datagram, &padded] {
            at += Duration::from_millis(1);
            if let Some(numbered) = decode(version, datagram) {
                reader.take(&mut state_queue, &numbered, at);
                reader.log_mode(&numbered.state);
                let _ = super::pose(&numbered.state.O_T_EE);
            }
        }
    }
    let mut newest = None;
    for state in &state_queue.queue {
        assert!(
            newest.is_none_or(|newest| state.stamp > newest) && state.stamp <= at,
            "{newest:?}, then {state:?}"
        );
        newest = Some(state.stamp);
        assert!(
            state.position.iter().all(|angle| angle.abs() <= MAX_RAD),
            "{state:?}"
        );
        assert!(
            state
                .velocity
                .iter()
                .chain(&state.effort)
                .all(|number| number.is_finite()),
            "{state:?}"
        );
    }
    let _ = state_queue.statistics.to_string();
    state_queue
        .queue
        .into_iter()
        .map(|state| state.position)
        .collect()
}

/// Encodes datagrams in the format of [`states`].
pub(crate) fn with_length_prefixes(datagrams: &[Vec<u8>]) -> Vec<u8> {
    datagrams
        .iter()
        .flat_map(|datagram| [&length_prefix(datagram)[..], datagram].concat())
        .collect()
}

fn length_prefix(datagram: &[u8]) -> [u8; 2] {
    u16::try_from(datagram.len())
        .expect("shorter than 64 kB")
        .to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::franka::emulated::fuzz::seeds::state_datagrams;
    use numbers::random::Random;

    #[test]
    fn corrupted_states_move_no_joint() {
        for version in VERSIONS {
            let datagrams = state_datagrams(version, 8);
            let expected = decode_positions(version, &with_length_prefixes(&datagrams));
            assert_eq!(expected.len(), 8, "{version:?}");
            let doubled: Vec<_> = datagrams
                .iter()
                .flat_map(|one| [one.clone(), one.clone()])
                .collect();
            assert_eq!(
                decode_positions(version, &with_length_prefixes(&doubled)),
                expected,
                "a duplicate is not a new state"
            );
            let mut random = Random::new(3);
            for _ in 0..20 {
                let mut shuffled = datagrams.clone();
                random.shuffle(&mut shuffled);
                let read = decode_positions(version, &with_length_prefixes(&shuffled));
                assert!(
                    read.iter().all(|positions| expected.contains(positions)),
                    "{read:?}"
                );
            }
            for n_bytes in [0, 1, 8, 100, datagrams[0].len() - 1] {
                assert!(
                    decode(version, &datagrams[0][..n_bytes]).is_none(),
                    "{n_bytes} bytes"
                );
            }
            assert!(decode(version, &datagrams[0].repeat(2)).is_none());
        }
    }
}
