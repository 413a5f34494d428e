//! Lenses and poses of the cameras of a preview, as far as they are known. A camera without
//! intrinsics or without a pose is shown as an image only.

use capture::config::{Camera, Parent, Rig};
use capture::open;
use keyframe::RobotState;
use kinematics::{Chain, Transform};

/// The cameras of a rig and the arm that moves some of them.
pub(super) struct CameraPoses {
    cameras: Vec<Camera>,
    /// The chain to the flange, and the index in the readings of each of its joints. `None` without
    /// such a chain.
    arm: Option<(Chain, Vec<usize>)>,
    /// Pose of a base that does not move.
    world_from_base: Transform,
}

impl CameraPoses {
    pub(super) fn new(rig: &Rig) -> Self {
        Self {
            cameras: rig.cameras.clone(),
            arm: arm_of(rig),
            world_from_base: rig.base.world_from_base,
        }
    }

    /// Adopts the calibration that the devices of a part of the rig report.
    pub(super) fn adopt(&mut self, opened: &Rig) {
        for camera in &mut self.cameras {
            if let Some(opened) = opened
                .cameras
                .iter()
                .find(|opened| opened.name == camera.name)
            {
                camera.intrinsics = opened.intrinsics.clone();
                camera.unknown.intrinsics = opened.unknown.intrinsics;
            }
        }
    }

    /// Focal length and principal point of a camera, pixels. If they are not known, the focal
    /// length is the width of the image; such a camera has no pose, so that nothing depends on it.
    pub(super) fn pinhole(&self, camera: &str, size_px: [u32; 2]) -> ([f64; 2], [f64; 2]) {
        match self.camera(camera).filter(|camera| has_intrinsics(camera)) {
            Some(Camera { intrinsics, .. }) => (intrinsics.focal_px, intrinsics.principal_px),
            None => {
                let [width, height] = size_px.map(f64::from);
                ([width; 2], [0.5 * width, 0.5 * height])
            }
        }
    }

    /// Pose of a camera for the newest state of the robot. `None` if its pose or its lens is not
    /// known, or if the robot that carries it has not reported its joints.
    ///
    /// The state is not interpolated to mid-exposure: an image waits for no reading, so the pose
    /// of a moving camera is ahead of its image by the latency of the image.
    pub(super) fn pose(&self, camera: &str, robot: Option<&RobotState>) -> Option<Transform> {
        let camera = self
            .camera(camera)
            .filter(|camera| has_intrinsics(camera) && !camera.unknown.parent_from_camera)?;
        let world_from_base = || robot.map_or(self.world_from_base, |robot| robot.world_from_base);
        let world_from_parent = match camera.parent {
            Parent::World => Transform::identity(),
            Parent::Base => world_from_base(),
            Parent::Flange => world_from_base() * self.base_from_flange(robot?)?,
        };
        Some(world_from_parent * camera.parent_from_camera)
    }

    fn base_from_flange(&self, robot: &RobotState) -> Option<Transform> {
        let (chain, order) = self.arm.as_ref()?;
        let positions: Option<Vec<f64>> = order
            .iter()
            .map(|ix| robot.positions.get(*ix).copied())
            .collect();
        chain.forward(&positions?).ok()
    }

    /// Positions of the cameras that do not move with the arm, in world, meters.
    pub(super) fn fixed_positions(&self) -> Vec<[f64; 3]> {
        let names = self.cameras.iter().map(|camera| &*camera.name);
        names
            .filter_map(|name| Some(self.pose(name, None)?.translation.vector.into()))
            .collect()
    }

    fn camera(&self, name: &str) -> Option<&Camera> {
        self.cameras.iter().find(|camera| &*camera.name == name)
    }
}

/// The chain of an arm that has joints.
fn arm_of(rig: &Rig) -> Option<(Chain, Vec<usize>)> {
    let chain = open::chain_of(rig).ok()?;
    let order = chain.order_in(&rig.arm.joints).ok()?;
    Some((chain, order))
}

/// Whether the intrinsics of a camera are in the rig file, or were reported by the camera.
fn has_intrinsics(camera: &Camera) -> bool {
    !camera.unknown.intrinsics
}

#[cfg(test)]
mod tests {
    use super::*;
    use capture::config::Override;
    use keyframe::RobotState;
    use kinematics::Stamp;
    use std::path::Path;
    use std::time::Instant;

    const CLOSE: f64 = 1e-9;

    fn rig(overrides: &[Override]) -> Rig {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
        Rig::load(&path, overrides).expect("a bundled rig file")
    }

    fn state(world_from_base: Transform, positions: Vec<f64>) -> RobotState {
        RobotState {
            stamp: Stamp(0),
            captured_at: Instant::now(),
            world_from_base,
            positions,
        }
    }

    #[test]
    fn a_camera_on_the_flange_moves_with_the_joints() {
        let rig = rig(&[]);
        let cameras = CameraPoses::new(&rig);
        assert_eq!(cameras.pose("wrist", None), None, "no joints were reported");
        let positions = vec![0.1, -0.5, 0.2, -2.0, 0.3, 1.8, 0.7];
        let world_from_base = Transform::translation(1.0, 2.0, 3.0);
        let pose = cameras
            .pose("wrist", Some(&state(world_from_base, positions.clone())))
            .expect("everything is known");
        let chain = open::chain_of(&rig).expect("a chain");
        let base_from_flange = chain.forward(&positions).expect("seven joints");
        let expected = world_from_base * base_from_flange * rig.cameras[0].parent_from_camera;
        let difference = expected.inverse() * pose;
        assert!(difference.translation.vector.norm() < CLOSE);
        assert!(difference.rotation.angle() < CLOSE);
        let too_few = state(world_from_base, vec![0.0; 3]);
        assert_eq!(cameras.pose("wrist", Some(&too_few)), None);
    }

    #[test]
    fn a_camera_whose_lens_or_pose_is_unknown_has_only_images() {
        let mut without_lens = rig(&[]);
        without_lens.cameras[0].unknown.intrinsics = true;
        let joints = state(Transform::identity(), vec![0.0; 7]);
        let mut cameras = CameraPoses::new(&without_lens);
        assert_eq!(cameras.pose("wrist", Some(&joints)), None);
        assert_eq!(
            cameras.pinhole("wrist", [640, 480]),
            ([640.0; 2], [320.0, 240.0])
        );
        // The opened camera reports its lens.
        cameras.adopt(&rig(&[]));
        assert!(cameras.pose("wrist", Some(&joints)).is_some());
        let mut without_pose = rig(&[]);
        without_pose.cameras[0].unknown.parent_from_camera = true;
        let cameras = CameraPoses::new(&without_pose);
        assert_eq!(cameras.pose("wrist", Some(&joints)), None);
    }

    #[test]
    fn fixed_cameras_need_no_robot() {
        let mut fixed = rig(&[]);
        fixed.cameras[0].parent = Parent::World;
        fixed.cameras[0].parent_from_camera = Transform::translation(0.5, 0.0, 1.0);
        let cameras = CameraPoses::new(&fixed);
        assert_eq!(cameras.fixed_positions(), [[0.5, 0.0, 1.0]]);
    }
}
