//! Fuzz target for model files: splats in `.ply`, `.spz` and `.splat`, and training checkpoints.
//!
//! The first byte selects the format of the other bytes: a complete `.ply`, the uncompressed
//! contents of a `.spz`, a complete `.spz`, a checkpoint without its checksum, or a complete
//! `.splat`.
#![no_main]

use model_files::checkpoint::Checkpoint;
use model_files::splat::{antimatter15, ply, spz};
use sha2::Digest;
use std::io::Write;
use std::path::PathBuf;

/// Writes a file in memory; each input overwrites it.
fn file(bytes: &[u8]) -> PathBuf {
    let path = PathBuf::from(format!("/dev/shm/fieldrig-model-{}", std::process::id()));
    std::fs::write(&path, bytes).expect("writing a small file");
    path
}

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let Some((kind, bytes)) = bytes.split_first() else { return };
    let splats = match kind % 5 {
        0 => {
            let path = file(bytes);
            if let Ok((points, _)) = ply::read_points(&path) {
                assert!(points.points_in_world_m.as_flattened().iter().all(|coordinate| coordinate.is_finite()));
                assert!([0, points.points_in_world_m.len()].contains(&points.colors_srgb.len()));
            }
            ply::read(&path)
        }
        1 => {
            let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
            gzip.write_all(bytes).expect("memory");
            spz::read(&file(&gzip.finish().expect("memory")))
        }
        2 => spz::read(&file(bytes)),
        4 => antimatter15::read(&file(bytes)),
        _ => {
            let sum = sha2::Sha256::digest(bytes);
            if let Ok(checkpoint) = Checkpoint::read(&file(&[bytes, &sum[..]].concat())) {
                let _ = checkpoint.array("means", 12);
            }
            return;
        }
    };
    let Ok(splats) = splats else { return };
    let path = file(&[]);
    // A format may reject positions outside its range. Every file that is written must be readable.
    for (write, read) in [(ply::write as fn(_, _) -> _, ply::read as fn(_) -> _), (spz::write, spz::read)] {
        if write(&path, &splats).is_ok() {
            let reread = read(&path).unwrap_or_else(|error: model_files::Error| panic!("{error:?}"));
            assert_eq!((reread.n_splats(), reread.sh_degree), (splats.n_splats(), splats.sh_degree));
        }
    }
});
