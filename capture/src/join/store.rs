//! The keyframe store, bounded in count and bytes. The most redundant keyframe is evicted first.
//!
//! A keyframe is evicted from the split (train, validation, test) that exceeds its share most. The
//! splits thus keep their proportions in a long run. If test keyframes were never evicted, they
//! would eventually fill the store. Within that split, the store evicts the keyframe that is
//! nearest to another keyframe of its camera. If two keyframes are equally near, the older one is
//! evicted.

use super::spacing::Spacing;
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use std::sync::Arc;

/// Shares of the splits. Of eight keyframes, one is for testing and one is for validation.
const SHARES: [(Split, f64); 3] = [
    (Split::Train, 6.0),
    (Split::Validation, 1.0),
    (Split::Test, 1.0),
];

/// Keyframes in order of acceptance.
#[derive(Debug)]
pub(super) struct KeyframeStore {
    max_keyframes: usize,
    max_bytes: u64,
    spacing: Spacing,
    kept: Vec<StoreEntry>,
    bytes: u64,
}

/// How full the store is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StoreUse {
    /// Number of keyframes in the store.
    pub keyframes: usize,
    /// Maximum number of keyframes.
    pub max_keyframes: usize,
    /// Memory of the keyframes, bytes.
    pub bytes: u64,
    /// Maximum memory of the keyframes, bytes.
    pub max_bytes: u64,
}

impl StoreUse {
    /// Whether the store is full, so that another keyframe of average size will replace others.
    #[must_use]
    pub fn is_full(&self) -> bool {
        let n = self.keyframes as u64;
        let next_bytes = self.bytes.checked_div(n).unwrap_or_default();
        n > 0
            && (self.keyframes >= self.max_keyframes
                || self.bytes.saturating_add(next_bytes) > self.max_bytes)
    }
}

#[derive(Debug)]
struct StoreEntry {
    keyframe: Arc<Keyframe>,
    bytes: u64,
    /// Distance to the nearest other keyframe of the same camera.
    nearest: f64,
}

impl KeyframeStore {
    pub(super) fn new(max_keyframes: usize, max_bytes: u64, spacing: Spacing) -> Self {
        Self {
            max_keyframes,
            max_bytes,
            spacing,
            kept: Vec::new(),
            bytes: 0,
        }
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Arc<Keyframe>> {
        self.kept.iter().map(|kept| &kept.keyframe)
    }

    pub(super) fn usage(&self) -> StoreUse {
        StoreUse {
            keyframes: self.kept.len(),
            max_keyframes: self.max_keyframes,
            bytes: self.bytes,
            max_bytes: self.max_bytes,
        }
    }

    /// Adds a keyframe. Returns the cameras and stamps of the evicted keyframes.
    pub(super) fn push(&mut self, keyframe: Arc<Keyframe>) -> Vec<(Arc<str>, Stamp)> {
        // Distances are symmetric, so one pass updates the entries and finds the distance of the
        // new keyframe. Only keyframes of the same camera are compared. Equal poses of two cameras
        // are not redundant, because their images differ.
        let mut nearest = f64::INFINITY;
        for kept in self
            .kept
            .iter_mut()
            .filter(|kept| kept.keyframe.camera == keyframe.camera)
        {
            let distance = self.spacing.between(
                &kept.keyframe.world_from_camera,
                &keyframe.world_from_camera,
            );
            kept.nearest = kept.nearest.min(distance);
            nearest = nearest.min(distance);
        }
        let bytes = keyframe.bytes();
        self.bytes += bytes;
        self.kept.push(StoreEntry {
            keyframe,
            bytes,
            nearest,
        });
        let mut evicted = Vec::new();
        // The last keyframe stays even if it alone exceeds the limit of bytes, because a run
        // without keyframes cannot train.
        while self.kept.len() > 1
            && (self.kept.len() > self.max_keyframes || self.bytes > self.max_bytes)
        {
            let keyframe = self.remove(self.most_redundant());
            evicted.push((Arc::clone(&keyframe.camera), keyframe.stamp));
        }
        evicted
    }

    fn most_redundant(&self) -> usize {
        #[expect(
            clippy::cast_precision_loss,
            reason = "a store holds far fewer than 2^53 keyframes"
        )]
        let load = |(split, share): &(Split, f64)| self.n_of(*split) as f64 / share;
        let fullest = SHARES
            .iter()
            .max_by(|a, b| load(a).total_cmp(&load(b)))
            .map(|(split, _)| *split);
        let candidates = self
            .kept
            .iter()
            .enumerate()
            .filter(|(_, kept)| Some(kept.keyframe.split) == fullest);
        // `min_by` returns the first of equal elements. Both keyframes of the closest pair have the
        // same distance, and the first is the older one.
        candidates
            .min_by(|(_, a), (_, b)| a.nearest.total_cmp(&b.nearest))
            .map_or(0, |(ix, _)| ix)
    }

    /// Number of keyframes of a split.
    fn n_of(&self, split: Split) -> usize {
        self.kept
            .iter()
            .filter(|kept| kept.keyframe.split == split)
            .count()
    }

    fn remove(&mut self, ix: usize) -> Arc<Keyframe> {
        let evicted = self.kept.remove(ix);
        self.bytes -= evicted.bytes;
        let same_camera: Vec<usize> = (0..self.kept.len())
            .filter(|ix| self.kept[*ix].keyframe.camera == evicted.keyframe.camera)
            .collect();
        let pose = |ix: usize| &self.kept[ix].keyframe.world_from_camera;
        // Only the keyframes whose nearest neighbor was the evicted one need a new distance.
        // Recomputing all would take quadratic time per keyframe in a full store.
        let orphaned: Vec<(usize, f64)> = same_camera
            .iter()
            .filter(|ix| {
                self.spacing
                    .between(pose(**ix), &evicted.keyframe.world_from_camera)
                    <= self.kept[**ix].nearest
            })
            .map(|ix| {
                let others = same_camera.iter().filter(|other| *other != ix);
                let distances = others.map(|other| self.spacing.between(pose(*ix), pose(*other)));
                (*ix, distances.fold(f64::INFINITY, f64::min))
            })
            .collect();
        for (ix, nearest) in orphaned {
            self.kept[ix].nearest = nearest;
        }
        evicted.keyframe
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Transform;
    use nalgebra::Vector3;

    #[test]
    fn a_store_is_full_if_the_next_keyframe_exceeds_a_limit() {
        let used = |keyframes, bytes| StoreUse {
            keyframes,
            max_keyframes: 4,
            bytes,
            max_bytes: 100,
        };
        assert!(!used(0, 0).is_full() && !used(3, 30).is_full());
        assert!(used(4, 40).is_full(), "in number");
        assert!(used(3, 76).is_full(), "in bytes");
        assert!(!used(3, 75).is_full());
    }

    fn keyframe(ix: usize, camera: &str, x_m: f64) -> Arc<Keyframe> {
        Arc::new(Keyframe {
            camera: camera.into(),
            stamp: Stamp(i64::try_from(ix).expect("small")),
            size_px: [2, 2],
            focal_px: [1.0; 2],
            principal_px: [1.0; 2],
            rgba_srgb: vec![0; 16].into(),
            depth: None,
            world_from_camera: Transform::new(Vector3::new(x_m, 0.0, 0.0), Vector3::zeros()),
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::of(ix),
            truth: None,
            robot: None,
        })
    }

    fn store(max_keyframes: usize, max_bytes: u64) -> KeyframeStore {
        KeyframeStore::new(
            max_keyframes,
            max_bytes,
            Spacing {
                translation_m: 1.0,
                rotation_rad: 1.0,
            },
        )
    }

    fn stamps(store: &KeyframeStore) -> Vec<i64> {
        store.iter().map(|keyframe| keyframe.stamp.0).collect()
    }

    #[test]
    fn most_redundant_keyframe_is_evicted_at_either_bound() {
        for mut store in [store(7, u64::MAX), store(usize::MAX, 7 * 16)] {
            let mut evicted = Vec::new();
            // 2 and 6 are close to each other. 1 and 8 are equally close but from different
            // cameras.
            for (ix, camera, x_m) in [
                (1, "a", 0.0),
                (2, "a", 9.0),
                (3, "a", 20.0),
                (5, "a", 30.0),
                (6, "a", 9.1),
                (7, "a", 40.0),
            ] {
                evicted.extend(store.push(keyframe(ix, camera, x_m)));
            }
            evicted.extend(store.push(keyframe(9, "b", 0.0)));
            assert_eq!(evicted, []);
            assert_eq!(
                store.push(keyframe(10, "a", 50.0)),
                [("a".into(), Stamp(2))]
            );
            assert_eq!(stamps(&store), [1, 3, 5, 6, 7, 9, 10]);
            // With 2 gone, 6 is isolated and the closest pair is the next one.
            assert_eq!(
                store.push(keyframe(11, "a", 20.5)),
                [("a".into(), Stamp(3))]
            );
        }
    }

    #[test]
    fn long_run_keeps_split_proportions_and_bounds() {
        let mut store = store(40, u64::MAX);
        for ix in 0..2000 {
            #[expect(clippy::cast_precision_loss, reason = "small numbers")]
            let x_m = (ix as f64 * 0.754_877).fract() * 10.0;
            store.push(keyframe(ix, "a", x_m));
            assert!(store.kept.len() <= 40 && store.bytes == store.kept.len() as u64 * 16);
        }
        let count = |split| {
            store
                .iter()
                .filter(|keyframe| keyframe.split == split)
                .count()
        };
        assert_eq!(
            [
                count(Split::Train),
                count(Split::Validation),
                count(Split::Test)
            ],
            [30, 5, 5]
        );
        // The cached distances are correct.
        for (ix, kept) in store.kept.iter().enumerate() {
            let others = store
                .kept
                .iter()
                .enumerate()
                .filter(|(other, _)| *other != ix);
            let poses = others.map(|(_, other)| &other.keyframe.world_from_camera);
            let nearest = poses
                .map(|pose| {
                    store
                        .spacing
                        .between(pose, &kept.keyframe.world_from_camera)
                })
                .fold(f64::INFINITY, f64::min);
            assert_eq!(kept.nearest, nearest);
        }
    }
}
