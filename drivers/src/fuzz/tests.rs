//! Feeds the seeds of the folder `fuzz`, unchanged and corrupted, to every reader.

use super::*;
use numbers::random::Random;
use std::path::{Path, PathBuf};

type Reader = fn(&[u8]);

/// Reader for each seed folder.
const READERS: [(&str, Reader); 9] = [
    ("can", frames),
    ("udp", datagrams),
    ("fci_states", states),
    ("fci_client", client),
    ("pixels", pixels),
    ("messages", messages),
    ("recording", recording),
    ("nerfstudio", nerfstudio),
    ("tum", tum),
];

fn seed_folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../fuzz/seeds")
        .join(name)
}

fn load_seeds(name: &str) -> Vec<Vec<u8>> {
    let folder = seed_folder(name);
    let mut paths: Vec<_> = std::fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    paths.sort();
    assert!(!paths.is_empty(), "{folder:?} has no seeds");
    paths
        .iter()
        .map(|path| std::fs::read(path).unwrap())
        .collect()
}

/// Corrupts the bytes: truncates, deletes or repeats a section, swaps two sections, or changes
/// bytes or bits at random.
fn corrupt(bytes: &mut Vec<u8>, random: &mut Random) {
    if bytes.is_empty() {
        return bytes.push(7);
    }
    let mut positions = [(); 3].map(|()| random.below(bytes.len() + 1));
    positions.sort_unstable();
    let [a, b, c] = positions;
    match random.below(6) {
        0 => bytes.truncate(b),
        1 => drop(bytes.drain(a..b)),
        2 => drop(bytes.splice(b..b, bytes[a..b].to_vec())),
        3 => bytes[a..c].rotate_left(b - a),
        4 => bytes[b.min(c.saturating_sub(1))..c]
            .iter_mut()
            .take(4)
            .for_each(|byte| *byte = random.byte()),
        _ => bytes[a.min(positions[2].saturating_sub(1))] ^= 1 << random.below(8),
    }
}

#[test]
fn corrupted_seeds_never_panic() {
    /// Each seed is corrupted a few times. File readers take 50 us per input.
    const N_CORRUPTED: usize = 400;
    for (name, read) in READERS {
        let mut random = Random::new(5);
        for seed in load_seeds(name) {
            read(&seed);
            for _ in 0..N_CORRUPTED {
                let mut bytes = seed.clone();
                (0..=random.below(4)).for_each(|_| corrupt(&mut bytes, &mut random));
                read(&bytes);
            }
        }
        for _ in 0..N_CORRUPTED {
            let n_bytes = random.below(300);
            read(&random.bytes(n_bytes));
        }
    }
}
