//! Fingerprint of the keyframe data that affect a model.

use crate::{DepthMap, Keyframe};
use kinematics::{Transform, Twist, transform};

/// Fingerprint of pixels, depth, intrinsics, pose, velocity and joint twists, without the split and
/// ground truth.
#[must_use]
pub fn fingerprint(keyframe: &Keyframe) -> u64 {
    let mut hash = Hash::default();
    hash.sizes(keyframe.size_px, keyframe.focal_px, keyframe.principal_px);
    hash.pose(&keyframe.world_from_camera);
    hash.number(keyframe.readout_secs);
    keyframe
        .twist
        .iter()
        .chain(keyframe.joint_twists.iter())
        .for_each(|twist| hash.twist(twist));
    hash.bytes(&keyframe.rgba_srgb);
    // The pattern names every field, so that a new field cannot be forgotten here.
    if let Some(DepthMap {
        size_px,
        focal_px,
        principal_px,
        depth_m,
        world_from_camera,
    }) = &keyframe.depth
    {
        hash.sizes(*size_px, *focal_px, *principal_px);
        hash.pose(world_from_camera);
        depth_m
            .iter()
            .for_each(|depth_m| hash.word(depth_m.to_bits().into()));
    }
    hash.0
}

/// A hash that processes eight bytes at a time, which is fast enough for live images.
struct Hash(u64);

impl Default for Hash {
    fn default() -> Self {
        Self(0x9e37_79b9_7f4a_7c15)
    }
}

impl Hash {
    fn word(&mut self, word: u64) {
        // A multiplication carries information only into the upper bits. The rotation moves the
        // upper bits down, so that the next multiplication spreads them to the bits above. An odd
        // factor keeps the map one to one, so that two different words cannot have the same result.
        self.0 = (self.0.rotate_left(29) ^ word).wrapping_mul(0xd134_2543_de82_ef95);
        self.0 ^= self.0 >> 32;
    }

    fn bytes(&mut self, bytes: &[u8]) {
        let (words, rest) = bytes.as_chunks::<8>();
        words
            .iter()
            .for_each(|word| self.word(u64::from_le_bytes(*word)));
        rest.iter().for_each(|byte| self.word((*byte).into()));
        // The length is part of the hash, because each remaining byte is a word of its own. Without
        // the length, trailing zeros would not change the hash.
        self.word(bytes.len() as u64);
    }

    fn number(&mut self, number: f64) {
        self.word(number.to_bits());
    }

    fn sizes(&mut self, size_px: [u32; 2], focal_px: [f64; 2], principal_px: [f64; 2]) {
        size_px.into_iter().for_each(|size| self.word(size.into()));
        focal_px
            .into_iter()
            .chain(principal_px)
            .for_each(|number| self.number(number));
    }

    fn twist(&mut self, twist: &Twist) {
        twist
            .linear_m_s
            .iter()
            .chain(twist.angular_rad_s.iter())
            .for_each(|number| self.number(*number));
    }

    fn pose(&mut self, pose: &Transform) {
        transform::to_xyz_xyzw(pose)
            .into_iter()
            .for_each(|number| self.number(number));
    }
}

#[cfg(test)]
mod tests {
    use super::{fingerprint as of, *};
    use crate::Split;
    use kinematics::Stamp;

    fn keyframe() -> Keyframe {
        let depth = DepthMap {
            size_px: [2, 1],
            focal_px: [3.0; 2],
            principal_px: [1.0; 2],
            depth_m: vec![1.0, 2.0].into(),
            world_from_camera: Transform::identity(),
        };
        Keyframe {
            camera: "wrist".into(),
            stamp: Stamp(5),
            size_px: [3, 1],
            focal_px: [4.0; 2],
            principal_px: [1.5; 2],
            rgba_srgb: (0..12).collect(),
            depth: Some(depth),
            world_from_camera: Transform::translation(1.0, 2.0, 3.0),
            twist: Some(Twist::zero()),
            joint_twists: [].into(),
            base: None,
            readout_secs: 0.01,
            split: Split::Train,
            truth: None,
            robot: None,
        }
    }

    #[test]
    fn fingerprint_covers_everything_a_model_uses() {
        let same = of(&keyframe());
        assert_eq!(
            of(&Keyframe {
                split: Split::Test,
                ..keyframe()
            }),
            same
        );
        let changes: [fn(&mut Keyframe); 10] = [
            |keyframe| keyframe.rgba_srgb = (1..13).collect(),
            |keyframe| keyframe.rgba_srgb = (0..11).chain([12]).collect(),
            |keyframe| keyframe.world_from_camera = Transform::translation(1.0, 2.0, 3.0 + 1e-15),
            |keyframe| keyframe.focal_px[1] = 5.0,
            |keyframe| keyframe.twist = None,
            |keyframe| keyframe.joint_twists = [Twist::zero()].into(),
            |keyframe| keyframe.readout_secs = 0.0,
            |keyframe| keyframe.depth = None,
            |keyframe| keyframe.depth.as_mut().expect("depth").depth_m = vec![1.0, 2.5].into(),
            |keyframe| keyframe.depth.as_mut().expect("depth").principal_px[0] = 1.25,
        ];
        let fingerprints = changes.map(|change| {
            let mut changed = keyframe();
            change(&mut changed);
            of(&changed)
        });
        let all: std::collections::BTreeSet<u64> = fingerprints.into_iter().chain([same]).collect();
        assert_eq!(all.len(), changes.len() + 1);
    }
}
