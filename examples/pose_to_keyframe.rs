//! Computes the pose of a camera on an arm at the middle of an exposure, and makes a keyframe.
//!
//! A real robot provides the same inputs: the URDF of the arm, stamped joint states, the pose of
//! the camera on the flange (hand-eye), the intrinsics of the camera, and an image with the time of
//! its exposure. `capture::Join` makes keyframes from all cameras of a rig, and decides which
//! images to accept.
//!
//! ```text
//! cargo run --example pose_to_keyframe
//! ```
#![expect(clippy::print_stdout, reason = "an example prints its result")]

use keyframe::{Keyframe, Split};
use kinematics::{
    Chain, Intrinsics, JointHistory, JointState, Lens, Stamp, Transform, Undistortion, transform,
};
use std::time::Duration;

const URDF: &str = r#"<robot name="two-joints">
  <link name="base"/> <link name="upper-arm"/> <link name="flange"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/> <child link="upper-arm"/> <origin xyz="0 0 0.4"/> <axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="50" velocity="2"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper-arm"/> <child link="flange"/> <origin xyz="0.5 0 0"/> <axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="50" velocity="2"/>
  </joint>
</robot>"#;
/// Maximum time between two joint states for an interpolation between them.
const MAX_GAP: Duration = Duration::from_millis(50);
const EXPOSURE_START: Stamp = Stamp(43_000_000);
const EXPOSURE_SECS: f64 = 0.008;
/// Time from the exposure of the first row to the exposure of the last row (rolling shutter).
const READOUT_SECS: f64 = 0.012;

fn main() -> anyhow::Result<()> {
    let chain = Chain::from_urdf(URDF, "base", "flange")?;
    let mut joints = JointHistory::new(MAX_GAP, 100);
    for ix in 0..=10 {
        joints.push(joint_state(Stamp(ix * 10_000_000)))?;
    }

    // The joints are interpolated at mid-exposure, because no joint state has exactly this stamp.
    let mid_exposure = EXPOSURE_START.plus_secs(0.5 * EXPOSURE_SECS);
    let state = joints.at(mid_exposure)?;
    let world_from_base = Transform::identity();
    let base_from_flange = chain.forward(&state.position)?;
    let flange_from_camera = hand_eye();
    let world_from_camera = world_from_base * base_from_flange * flange_from_camera;
    let flange_twist = chain.tip_twist(&state.position, &state.velocity)?;

    // A keyframe contains an undistorted image, and the intrinsics of the pinhole camera that would
    // have taken this image.
    let intrinsics = intrinsics();
    let pinhole = intrinsics.undistorted();
    let rgba_srgb = Undistortion::new(&intrinsics).apply_rgb(&image_rgb(intrinsics.size_px))?;
    let keyframe = Keyframe {
        camera: "wrist".into(),
        stamp: mid_exposure,
        size_px: pinhole.size_px,
        focal_px: pinhole.focal_px,
        principal_px: pinhole.principal_px,
        rgba_srgb: rgba_srgb.into(),
        depth: None,
        world_from_camera,
        twist: Some(flange_twist.of_attached(&flange_from_camera)),
        readout_secs: READOUT_SECS,
        joint_twists: [].into(),
        base: None,
        split: Split::Train,
        truth: None,
        robot: None,
    };
    keyframe.check()?;

    let [x, y, z, ..] = transform::to_xyz_xyzw(&keyframe.world_from_camera);
    println!(
        "camera {:?} at {:.1} ms: x {x:.4} m, y {y:.4} m, z {z:.4} m",
        keyframe.camera,
        1e3 * keyframe.stamp.secs()
    );
    Ok(())
}

/// The joint state of an arm whose shoulder joint rotates at 0.5 rad/s.
fn joint_state(stamp: Stamp) -> JointState {
    JointState {
        stamp,
        position: vec![0.5 * stamp.secs(), 0.2],
        velocity: vec![0.5, 0.0],
        effort: Vec::new(),
    }
}

/// The pose `flange_from_camera`. The camera is 5 cm in front of the flange, and looks along the x
/// axis of the flange. The camera's own axes are x right, y down, z forward.
fn hand_eye() -> Transform {
    transform::from_xyz_xyzw([0.05, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5])
}

fn intrinsics() -> Intrinsics {
    Intrinsics {
        size_px: [160, 120],
        focal_px: [140.0, 140.0],
        principal_px: [80.0, 60.0],
        lens: Lens::BrownConrady([-0.2, 0.05, 0.0, 0.0, 0.0]),
        rectified: false,
    }
}

/// The pixels of a gray image, in the shape `[height, width, 3]`.
fn image_rgb([width, height]: [u32; 2]) -> Vec<u8> {
    vec![128; 3 * width as usize * height as usize]
}
