//! Pixels at which the robot is visible in a view of a scene, for tests of programs that draw the
//! robot.

use crate::config::N_JOINTS;
use crate::egl::HeadlessContext;
use crate::render::{Canvas, View};
use crate::robot::RobotPose;
use crate::{Config, Error, Scene, scene};
use kinematics::Transform;
use std::sync::Arc;

/// A pinhole view of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct PinholeView {
    /// Width and height, pixels. Both are at most as large as the size with which
    /// [`RobotMasks::open`] was called.
    pub size_px: [u32; 2],
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
    /// Pose of the camera.
    pub world_from_camera: Transform,
}

/// Draws a scene and a robot that has no cameras on its flange. The drawing happens on the thread
/// that has opened this value.
pub struct RobotMasks {
    // This field is dropped before the context.
    canvas: Canvas,
    _context: HeadlessContext,
}

impl RobotMasks {
    /// Builds a scene with an arm, for views of up to `largest_px`.
    ///
    /// # Errors
    ///
    /// Fails if OpenGL cannot be used, or the scene is invalid.
    pub fn open(scene: Scene, largest_px: [u32; 2]) -> Result<Self, Error> {
        let config = Config {
            scene,
            cameras: Vec::new(),
            ..Config::default()
        };
        let model = Arc::new(scene::build(&config, largest_px)?);
        let context = HeadlessContext::open()?;
        let canvas = Canvas::new(&context, &model, scene::near_far_m(scene));
        Ok(Self {
            canvas,
            _context: context,
        })
    }

    /// The pixels at which MuJoCo's segmentation shows the robot, row by row. If `is_alone`, the
    /// scene contains nothing else.
    ///
    /// * `joints_rad`: positions of the arm's joints from base to flange.
    ///
    /// # Errors
    ///
    /// Fails if the arm has another number of joints.
    pub fn mask(
        &mut self,
        view: &PinholeView,
        world_from_base: &Transform,
        joints_rad: &[f64],
        is_alone: bool,
    ) -> Result<Vec<bool>, Error> {
        if joints_rad.len() != N_JOINTS {
            return Err(Error::NJoints {
                got: joints_rad.len(),
                expected: N_JOINTS,
            });
        }
        let robot = RobotPose {
            world_from_base: *world_from_base,
            world_from_flange: Transform::identity(), // No camera of this model is on the flange.
            model_positions: joints_rad.to_vec(),
        };
        Ok(self.canvas.robot_mask(&drawn(view, Some(robot)), is_alone))
    }

    /// Depth of the scene without the robot, row by row, meters along z. Pixels that show nothing
    /// have the depth of the far plane.
    pub fn depth_without_robot_m(&mut self, view: &PinholeView) -> Vec<f32> {
        self.canvas.draw(&drawn(view, None)).depth_m
    }
}

fn drawn(view: &PinholeView, robot: Option<RobotPose>) -> View {
    View {
        size_px: view.size_px,
        focal_px: view.focal_px,
        principal_px: view.principal_px,
        world_from_camera: view.world_from_camera,
        is_robot_visible: robot.is_some(),
        robot,
        light_frac: 1.0,
        world_from_boards: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Point3, UnitQuaternion, Vector3};

    /// Seen from behind a wall of the scene.
    fn view() -> PinholeView {
        let eye = Point3::new(0.75, -1.2, 0.9);
        let rotation =
            UnitQuaternion::face_towards(&(Point3::new(0.15, 0.0, 0.35) - eye), &-Vector3::z());
        PinholeView {
            size_px: [160, 120],
            focal_px: [150.0; 2],
            principal_px: [80.0, 60.0],
            world_from_camera: Transform::from_parts(eye.into(), rotation),
        }
    }

    #[test]
    fn segmentation_agrees_with_the_kinematics_and_hides_what_is_behind() {
        let mut masks = RobotMasks::open(Scene::StaticArm, [160, 120]).expect("the scene is valid");
        let (view, base) = (view(), Transform::identity());
        let joints = [0.3, -0.5, 0.2, -2.1, 0.4, 1.7, 0.6];
        let mut mask = |is_alone| {
            masks
                .mask(&view, &base, &joints, is_alone)
                .expect("seven joints")
        };
        let [alone, visible] = [true, false].map(&mut mask);
        let count = |mask: &[bool]| mask.iter().filter(|is_robot| **is_robot).count();
        assert!(
            alone
                .iter()
                .zip(&visible)
                .all(|(alone, visible)| *alone || !visible),
            "the robot alone covers more"
        );
        assert!(
            count(&alone) > 500 && (100..count(&alone)).contains(&count(&visible)),
            "{} {}",
            count(&alone),
            count(&visible)
        );
        // The flange is inside the body.
        let flange = crate::panda::base_from_flange(&crate::panda::Joints::from(joints))
            * Point3::new(0.0, 0.0, -0.03);
        let in_camera = view.world_from_camera.inverse_transform_point(&flange);
        let at = |axis: usize| {
            view.focal_px[axis] * in_camera[axis] / in_camera.z + view.principal_px[axis]
        };
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a pixel of the view"
        )]
        let ix = at(1) as usize * 160 + at(0) as usize;
        assert!(alone[ix], "{:?}", [at(0), at(1)]);
        let depth_m = masks.depth_without_robot_m(&view);
        assert!(
            depth_m.iter().all(|depth| (0.02..12.1).contains(depth))
                && depth_m.iter().any(|depth| *depth < 2.0)
        );
        assert!(masks.mask(&view, &base, &joints[..6], true).is_err());
    }
}
