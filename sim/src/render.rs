//! Renders the scene on a separate thread with one OpenGL context for all cameras.
#![expect(
    unsafe_code,
    reason = "the scene's cameras are set through MuJoCo's C structs"
)]
#![expect(clippy::cast_possible_truncation, reason = "OpenGL works in f32")]

use crate::Error;
use crate::egl::HeadlessContext;
use crate::robot::RobotPose;
use crate::scene::ARM_GROUP;
use crossbeam_channel::{Receiver, Sender, bounded};
use kinematics::Transform;
use mujoco_rs::prelude::{
    MjData, MjModel, MjrContext, MjrRectangle, MjtObj, MjtRndFlag, MjvCamera, MjvOption,
    MjvPerturb, MjvScene,
};
use mujoco_rs::wrappers::traits::ModelType;
use nalgebra::Vector3;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::thread::JoinHandle;

/// A pinhole view to render.
#[derive(Clone, Debug)]
pub(crate) struct View {
    pub(crate) size_px: [u32; 2],
    pub(crate) focal_px: [f64; 2],
    pub(crate) principal_px: [f64; 2],
    pub(crate) world_from_camera: Transform,
    /// Pose of the robot. `None` if nothing in the image depends on it.
    pub(crate) robot: Option<RobotPose>,
    /// Whether the robot is drawn and casts a shadow.
    pub(crate) is_robot_visible: bool,
    /// Brightness of all lamps, where 1 is nominal.
    pub(crate) light_frac: f64,
    /// Poses of the targets that are moved by hand, in the order of the configuration.
    pub(crate) world_from_boards: Vec<Transform>,
}

impl View {
    /// A small view at the origin.
    fn warm_up() -> Self {
        Self {
            size_px: [16, 16],
            focal_px: [16.0; 2],
            principal_px: [8.0; 2],
            world_from_camera: Transform::identity(),
            robot: None,
            is_robot_visible: false,
            light_frac: 1.0,
            world_from_boards: Vec::new(),
        }
    }
}

/// A rendered image, starting at the top left.
#[derive(Clone, Debug)]
pub(crate) struct Picture {
    pub(crate) size_px: [u32; 2],
    /// `[height, width, 3]`, sRGB.
    pub(crate) rgb: Vec<u8>,
    /// `[height, width]`, meters along z.
    pub(crate) depth_m: Vec<f32>,
}

/// Sends views to the render thread. Dropping it ends the thread.
pub(crate) struct Renderer {
    job_sender: Option<Sender<Job>>,
    thread: Option<JoinHandle<()>>,
    name: String,
}

struct Job {
    view: View,
    reply: Sender<Picture>,
}

/// An image being rendered.
pub(crate) struct Pending(Receiver<Picture>);

impl Pending {
    /// Waits for the image.
    pub(crate) fn wait(self) -> Result<Picture, Error> {
        self.0.recv().map_err(|_| render_thread_stopped())
    }
}

fn render_thread_stopped() -> Error {
    Error::Stopped {
        reason: "it sent no image".to_owned(),
    }
}

impl Renderer {
    /// Starts the thread and its context.
    pub(crate) fn start(model: Arc<MjModel>, near_far_m: [f64; 2]) -> Result<Self, Error> {
        // The queue is bounded, so that the simulation cannot run far ahead of the rendering.
        let (job_sender, queue) = bounded::<Job>(4);
        let (ready, started) = bounded(1);
        let thread = std::thread::Builder::new()
            .name("sim-render".to_owned())
            .spawn(move || match HeadlessContext::open() {
                Ok(context) => draw_all(&context, &model, near_far_m, &ready, &queue),
                Err(error) => {
                    let _ = ready.send(Err(error));
                }
            })
            .map_err(Error::Thread)?;
        let name = started.recv().map_err(|_| render_thread_stopped())??;
        Ok(Self {
            job_sender: Some(job_sender),
            thread: Some(thread),
            name,
        })
    }

    /// The renderer's name as reported by OpenGL.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Queues a view. The caller waits for the result later.
    pub(crate) fn submit(&self, view: View) -> Result<Pending, Error> {
        let (reply, picture) = bounded(1);
        let job_sender = self.job_sender.as_ref().ok_or_else(render_thread_stopped)?;
        job_sender
            .send(Job { view, reply })
            .map_err(|_| render_thread_stopped())?;
        Ok(Pending(picture))
    }
}

impl Drop for Renderer {
    fn drop(&mut self) {
        // Closing the channel ends the loop of the thread.
        self.job_sender = None;
        if let Some(thread) = self.thread.take() {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// Renders until the last sender is dropped. The context outlives everything that MuJoCo created in
/// it.
fn draw_all(
    current: &HeadlessContext,
    model: &Arc<MjModel>,
    near_far_m: [f64; 2],
    ready: &Sender<Result<String, Error>>,
    queue: &Receiver<Job>,
) {
    let mut canvas = Canvas::new(current, model, near_far_m);
    // OpenGL drivers compile their shaders for the first image, which takes seconds on a busy
    // processor. Without this warm-up, cameras would send no images during this time.
    canvas.draw(&View::warm_up());
    // A closed channel means that the rig was dropped. `queue` is then closed, too.
    let _ = ready.send(Ok(current.renderer().to_owned()));
    for job in queue {
        // Sending fails if the requester has given up. Later requesters may still be waiting.
        let _ = job.reply.send(canvas.draw(&job.view));
    }
}

/// Draws a model with the context of this thread.
pub(crate) struct Canvas {
    scene: MjvScene,
    data: MjData<Arc<MjModel>>,
    context: MjrContext,
    near_far_m: [f64; 2],
}

impl Canvas {
    /// The context must outlive the canvas.
    pub(crate) fn new(
        _current: &HeadlessContext,
        model: &Arc<MjModel>,
        near_far_m: [f64; 2],
    ) -> Self {
        // SAFETY: an OpenGL context is current on this thread until after the canvas is dropped.
        // Only this model is drawn.
        let mut context = unsafe { MjrContext::new(model) };
        context.offscreen();
        Self {
            scene: MjvScene::new(model, usize::try_from(model.ffi().ngeom).unwrap_or(0) + 16),
            data: MjData::new(Arc::clone(model)),
            context,
            near_far_m,
        }
    }

    pub(crate) fn draw(&mut self, view: &View) -> Picture {
        let mut options = MjvOption::default();
        options.geomgroup[ARM_GROUP] = view.is_robot_visible.into();
        self.draw_with(view, &options)
    }

    /// The pixels at which MuJoCo's segmentation shows the robot. If `is_alone` is set, only the
    /// robot is drawn.
    pub(crate) fn robot_mask(&mut self, view: &View, is_alone: bool) -> Vec<bool> {
        let mut options = MjvOption::default();
        if is_alone {
            options.geomgroup.fill(0);
        }
        // The robot is drawn even if other geometry is hidden.
        options.geomgroup[ARM_GROUP] = 1;
        self.set_segmentation(true);
        let picture = self.draw_with(view, &options);
        self.set_segmentation(false);
        let groups = self.data.model().geom_group();
        let is_arm =
            |object: i32| usize::try_from(object).is_ok_and(|ix| groups[ix] == ARM_GROUP as i32);
        let geoms = self
            .scene
            .geoms()
            .iter()
            .filter(|geom| geom.objtype == MjtObj::mjOBJ_GEOM as i32);
        let arm: BTreeSet<i32> = geoms
            .filter(|geom| is_arm(geom.objid))
            .map(|geom| geom.segid)
            .collect();
        // MuJoCo adds 1 to the number of each geometry, because 0 is the background.
        let number =
            |rgb: &[u8]| i32::from(rgb[0]) + (i32::from(rgb[1]) << 8) + (i32::from(rgb[2]) << 16);
        picture
            .rgb
            .chunks_exact(3)
            .map(|rgb| arm.contains(&(number(rgb) - 1)))
            .collect()
    }

    fn set_segmentation(&mut self, is_on: bool) {
        // SAFETY: only flags are written.
        let scene = unsafe { self.scene.ffi_mut() };
        for flag in [MjtRndFlag::mjRND_SEGMENT, MjtRndFlag::mjRND_IDCOLOR] {
            scene.flags[flag as usize] = is_on.into();
        }
    }

    fn draw_with(&mut self, view: &View, options: &MjvOption) -> Picture {
        if let Some(robot) = &view.robot {
            // Only the poses are set, because velocities and forces do not affect an image.
            if !robot.model_positions.is_empty() {
                self.data.qpos_mut().copy_from_slice(&robot.model_positions);
            }
            set_base_pose(&mut self.data, &robot.world_from_base);
        }
        // A moving base comes before the targets, so that they are the last moved bodies.
        let n_moved = self.data.mocap_pos_mut().len();
        let first = n_moved.saturating_sub(view.world_from_boards.len());
        for (ix, world_from_board) in view.world_from_boards.iter().enumerate() {
            set_moved_pose(&mut self.data, first + ix, world_from_board);
        }
        self.data.forward_kinematics();
        self.scene.update(
            &mut self.data,
            options,
            &MjvPerturb::default(),
            &mut MjvCamera::default(),
        );
        self.set_view(view);
        self.scale_lights(view.light_frac as f32);
        let [width, height] = view.size_px;
        let viewport = MjrRectangle::new(
            0,
            0,
            i32::try_from(width).unwrap_or(0),
            i32::try_from(height).unwrap_or(0),
        );
        self.scene.render(&viewport, &self.context);
        self.read(view.size_px, &viewport)
    }

    /// Sets both stereo cameras of the scene. MuJoCo renders from their mean.
    fn set_view(&mut self, view: &View) {
        let [near, far] = self.near_far_m;
        let pose = &view.world_from_camera;
        let in_f32 = |vector: Vector3<f64>| [vector.x as f32, vector.y as f32, vector.z as f32];
        let [width, height] = view.size_px.map(f64::from);
        let at_near = |pixels: f64, axis: usize| pixels * near / view.focal_px[axis];
        // An off-center frustum gives the principal point of the camera. In OpenGL, y points up,
        // but in the image, y points down, so top and bottom are swapped.
        let [left, right] = [
            at_near(-view.principal_px[0], 0),
            at_near(width - view.principal_px[0], 0),
        ];
        // SAFETY: only cameras and flags are written, and they contain only numbers.
        let scene = unsafe { self.scene.ffi_mut() };
        for camera in &mut scene.camera {
            camera.pos = in_f32(pose.translation.vector);
            camera.forward = in_f32(pose.rotation * Vector3::z());
            camera.up = in_f32(pose.rotation * -Vector3::y());
            camera.frustum_center = (0.5 * (left + right)) as f32;
            camera.frustum_width = (0.5 * (right - left)) as f32;
            camera.frustum_top = at_near(view.principal_px[1], 1) as f32;
            camera.frustum_bottom = at_near(view.principal_px[1] - height, 1) as f32;
            camera.frustum_near = near as f32;
            camera.frustum_far = far as f32;
            camera.orthographic = 0;
        }
    }

    /// Scales the brightness of all lamps.
    fn scale_lights(&mut self, light_frac: f32) {
        // SAFETY: only colors of lamps are written, and they contain only numbers.
        let scene = unsafe { self.scene.ffi_mut() };
        let n_lamps = usize::try_from(scene.nlight).unwrap_or(0);
        for lamp in scene.lights.iter_mut().take(n_lamps) {
            for channel in lamp
                .ambient
                .iter_mut()
                .chain(&mut lamp.diffuse)
                .chain(&mut lamp.specular)
            {
                *channel *= light_frac;
            }
        }
    }

    fn read(&self, size_px: [u32; 2], viewport: &MjrRectangle) -> Picture {
        let [width, height] = size_px.map(|side| side as usize);
        let mut from_bottom = vec![0; 3 * width * height];
        let mut depth_from_bottom = vec![0.0; width * height];
        self.context
            .read_pixels(
                Some(&mut from_bottom),
                Some(&mut depth_from_bottom),
                viewport,
            )
            .expect("the buffers match the viewport's size");
        let mut rgb = Vec::with_capacity(from_bottom.len());
        let mut depth_m = Vec::with_capacity(depth_from_bottom.len());
        // OpenGL returns the bottom row first.
        for row in (0..height).rev() {
            rgb.extend_from_slice(&from_bottom[3 * width * row..3 * width * (row + 1)]);
            depth_m.extend(
                depth_from_bottom[width * row..width * (row + 1)]
                    .iter()
                    .map(|depth| meters_from_depth(*depth, self.near_far_m)),
            );
        }
        Picture {
            size_px,
            rgb,
            depth_m,
        }
    }
}

/// Converts the depth of the perspective projection to meters. That depth is 0 at the near plane
/// and 1 at the far plane.
fn meters_from_depth(depth: f32, near_far_m: [f64; 2]) -> f32 {
    let [near, far] = near_far_m.map(|meters| meters as f32);
    near * far / (far - depth * (far - near))
}

/// Sets the pose of a moving base. Does nothing for a fixed base.
pub(crate) fn set_base_pose<M: ModelType>(data: &mut MjData<M>, world_from_base: &Transform) {
    set_moved_pose(data, 0, world_from_base);
}

/// Sets the pose of a body that is moved from outside of the physics, by its index. Does nothing if
/// there is no such body.
fn set_moved_pose<M: ModelType>(data: &mut MjData<M>, moved_ix: usize, pose: &Transform) {
    if let Some(position) = data.mocap_pos_mut().get_mut(moved_ix) {
        *position = pose.translation.vector.into();
    }
    if let Some(rotation_wxyz) = data.mocap_quat_mut().get_mut(moved_ix) {
        let q = pose.rotation.coords;
        *rotation_wxyz = [q.w, q.x, q.y, q.z];
    }
}
