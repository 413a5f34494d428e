//! Why a live run ended without a model.

use capture::config::Rig;
use capture::{Counts, Rejection};

/// A sentence that explains why a run ended without a model.
pub(super) fn no_model_reason(n_keyframes: usize, counts: &Counts, rig: &Rig) -> String {
    let expected = quoted_names(rig.cameras.iter().map(|camera| &*camera.name));
    let unknown = quoted_names(counts.unknown_cameras.iter().map(|name| &**name));
    let n_unknown = counts
        .rejected
        .get(&Rejection::UnknownCamera)
        .copied()
        .unwrap_or_default();
    match (n_keyframes, counts.accepted) {
        (1, _) => format!("nothing to train on: the only keyframe is a test image ({counts})"),
        (2.., _) => {
            format!("nothing to train on: all {n_keyframes} keyframes are test images ({counts})")
        }
        (0, 1..) => format!("the run ended before the trainer received a keyframe ({counts})"),
        (0, 0) if counts.images == 0 => {
            format!(
                "no image arrived before the run ended; the rig file has the cameras {expected}"
            )
        }
        (0, 0) if n_unknown == counts.images => {
            format!(
                "no image is from a camera in the rig file ({expected}): all {n_unknown} are from {unknown}"
            )
        }
        (0, 0) => format!("no image became a keyframe: {counts}"),
    }
}

fn quoted_names<'a>(names: impl Iterator<Item = &'a str>) -> String {
    names
        .map(|name| format!("{name:?}"))
        .collect::<Vec<_>>()
        .join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn run_without_a_model_reports_the_reason() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
        let rig = Rig::load(&path, &[]).expect("a rig");
        let counts = |images, accepted, rejected: &[(Rejection, u64)]| Counts {
            images,
            accepted,
            rejected: rejected.iter().copied().collect(),
            unknown_cameras: ["front".into()].into(),
            ..Counts::default()
        };
        for (n_keyframes, counts, expected) in [
            (
                1,
                counts(1, 1, &[]),
                "the only keyframe is a test image (1 keyframe of 1 image)",
            ),
            (
                0,
                counts(1, 1, &[]),
                "ended before the trainer received a keyframe",
            ),
            (
                0,
                counts(0, 0, &[]),
                "no image arrived before the run ended",
            ),
            (
                0,
                counts(7, 0, &[(Rejection::UnknownCamera, 7)]),
                "(\"wrist\"): all 7 are from \"front\"",
            ),
            (
                0,
                counts(7, 0, &[(Rejection::NoPose, 7)]),
                "0 keyframes of 7 images; 7 no joint states or base pose",
            ),
        ] {
            let message = no_model_reason(n_keyframes, &counts, &rig);
            assert!(message.contains(expected), "{message}");
        }
    }
}
