//! The camera of a view, and its uniform buffer.

use crate::RenderRequest;
use keyframe::Shutter;
use kinematics::Transform;
use model_files::{Aabb, Edits};
use numbers::{f32_of, f32s_of};
use std::sync::Arc;

/// Edge of a tile, pixels, as in Kerbl et al. 2023. With larger tiles, fewer entries are sorted. In
/// smaller tiles, fewer pixels test splats that do not cover them.
pub(crate) const TILE_PX: u32 = 16;

/// `View` of shared/view.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct View {
    pub(crate) camera_row_0: [f32; 4],
    pub(crate) camera_row_1: [f32; 4],
    pub(crate) camera_row_2: [f32; 4],
    pub(crate) center_in_world: [f32; 4],
    pub(crate) focal_px: [f32; 2],
    pub(crate) principal_px: [f32; 2],
    pub(crate) size_px: [u32; 2],
    pub(crate) n_tiles: [u32; 2],
    pub(crate) shutter_linear: [f32; 4],
    pub(crate) shutter_angular: [f32; 4],
    pub(crate) crop_row_0: [f32; 4],
    pub(crate) crop_row_1: [f32; 4],
    pub(crate) crop_row_2: [f32; 4],
    pub(crate) crop_min: [f32; 4],
    pub(crate) crop_max: [f32; 4],
}

/// Camera parameters from which a [`View`] is computed.
#[derive(Clone, Debug)]
pub(crate) struct Camera {
    pub(crate) world_from_camera: Transform,
    pub(crate) size_px: [u32; 2],
    pub(crate) focal_px: [f64; 2],
    pub(crate) principal_px: [f64; 2],
    pub(crate) shutter: Option<Shutter>,
    pub(crate) near_m: f64,
    pub(crate) far_m: f64,
    pub(crate) crop: Option<Aabb>,
    /// Erased space, in world.
    pub(crate) edits: Arc<Edits>,
    /// Variance added to every splat on the image plane, pixels squared.
    pub(crate) low_pass_px2: f64,
}

/// Variance of the low-pass at full size, pixels squared, as in Kerbl et al. 2023. With this value,
/// a splat covers at least about one pixel. A larger value blurs the picture. With a smaller value,
/// splats fall between pixel centers.
pub(crate) const LOW_PASS_PX2: f64 = 0.3;

impl Camera {
    /// The pinhole camera of a requested picture.
    pub(crate) fn from_request(
        request: &RenderRequest,
        focal_px: [f64; 2],
        principal_px: [f64; 2],
    ) -> Self {
        Self {
            world_from_camera: request.world_from_camera,
            size_px: request.size_px,
            focal_px,
            principal_px,
            shutter: request.shutter,
            near_m: request.near_m,
            far_m: request.far_m,
            crop: request.crop,
            edits: Arc::clone(&request.edits),
            low_pass_px2: LOW_PASS_PX2,
        }
    }

    /// This camera with an image that is smaller by the factor `2^level`. Leftover rows and columns
    /// at the far edges are cropped.
    pub(crate) fn at_level(&self, level: u32) -> Self {
        let share = 0.5f64.powi(i32::try_from(level).expect("a few levels"));
        Self {
            size_px: self.size_px.map(|size| (size >> level).max(1)),
            focal_px: self.focal_px.map(|focal| focal * share),
            principal_px: self.principal_px.map(|principal| principal * share),
            // Keeps the filter width in the world constant.
            low_pass_px2: self.low_pass_px2 * share * share,
            ..self.clone()
        }
    }

    /// The view that the kernels read.
    pub(crate) fn view(&self) -> View {
        // Kernels scale the motion by the row of a pixel, so they need the motion during a readout
        // instead of velocity and time.
        let linear = during_readout(self.shutter.as_ref(), |shutter| shutter.twist.linear_m_s);
        let angular = during_readout(self.shutter.as_ref(), |shutter| shutter.twist.angular_rad_s);
        let center = f32s_of::<3>(self.world_from_camera.translation.vector.into());
        // The fourth number of a row would be padding, so it holds a scalar of the view.
        let with = |xyz: [f32; 3], w: f32| [xyz[0], xyz[1], xyz[2], w];
        let crop_w = if self.crop.is_some() { 1.0 } else { 0.0 };
        let camera = rows_of(&self.world_from_camera.inverse());
        let crop = rows_of(
            &self
                .crop
                .map_or(Transform::identity(), |crop| crop.world_from_box.inverse()),
        );
        View {
            camera_row_0: camera[0],
            camera_row_1: camera[1],
            camera_row_2: camera[2],
            center_in_world: with(center, f32_of(self.low_pass_px2)),
            focal_px: f32s_of(self.focal_px),
            principal_px: f32s_of(self.principal_px),
            size_px: self.size_px,
            n_tiles: self.size_px.map(|size| size.div_ceil(TILE_PX)),
            shutter_linear: with(linear, f32_of(self.near_m)),
            shutter_angular: with(angular, f32_of(self.far_m)),
            crop_row_0: crop[0],
            crop_row_1: crop[1],
            crop_row_2: crop[2],
            crop_min: with(
                self.crop.map_or([0.0; 3], |crop| f32s_of(crop.min_m)),
                crop_w,
            ),
            crop_max: with(self.crop.map_or([0.0; 3], |crop| f32s_of(crop.max_m)), 0.0),
        }
    }
}

/// Motion of the camera during a readout, from the velocity that `velocity` selects. It is zero for
/// a global shutter.
fn during_readout(
    shutter: Option<&Shutter>,
    velocity: fn(&Shutter) -> nalgebra::Vector3<f64>,
) -> [f32; 3] {
    shutter.map_or([0.0; 3], |shutter| {
        f32s_of((velocity(shutter) * shutter.readout_secs).into())
    })
}

/// The upper three rows of the transform's matrix.
pub(crate) fn rows_of(transform: &Transform) -> [[f32; 4]; 3] {
    let matrix = transform.to_homogeneous();
    std::array::from_fn(|row| std::array::from_fn(|column| f32_of(matrix[(row, column)])))
}
