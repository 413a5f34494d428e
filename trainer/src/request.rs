//! Requests for pictures of a model, and the rendered pictures.

use gpu::Buffer;
use keyframe::Shutter;
use kinematics::{Stamp, Transform};
use model_files::{Aabb, Edits};
use std::sync::Arc;

/// How directions map to pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Projection {
    /// Pinhole camera. Focal length and principal point are in pixels of the full-size picture.
    Pinhole {
        /// Focal length, pixels.
        focal_px: [f64; 2],
        /// Principal point, pixels.
        principal_px: [f64; 2],
    },
    /// All directions. Longitude runs along x from -180 to 180 degrees, and latitude along y from
    /// up to down. The forward direction is in the center.
    Equirectangular,
}

/// A request for a picture.
#[derive(Clone, Debug)]
pub struct RenderRequest {
    /// Pose of the virtual camera.
    pub world_from_camera: Transform,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// How directions map to pixels.
    pub projection: Projection,
    /// Rolling shutter to simulate, for comparison with a real image. `None` for viewers.
    pub shutter: Option<Shutter>,
    /// Smallest depth along z that is rendered, meters.
    pub near_m: f64,
    /// Largest depth along z that is rendered, meters.
    pub far_m: f64,
    /// Only space inside this box is rendered.
    pub crop: Option<Aabb>,
    /// Erased space, which is not rendered.
    pub edits: Arc<Edits>,
    /// Background color, sRGB 0 to 1.
    pub background_srgb: [f32; 3],
    /// Camera and stamp of the image whose lighting and exposure are used, if the model has them.
    /// `None` selects the mean of the images.
    pub appearance_of: Option<(Arc<str>, Stamp)>,
    /// Whether depth is requested. Without depth, [`Picture::depth_m`] is empty and the GPU
    /// readback is half as large.
    pub depth: bool,
}

/// A rendered picture.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Array `[height, width, 4]` of sRGB over the background. Alpha is coverage.
    pub rgba_srgb: Vec<u8>,
    /// Array `[height, width]` of depths along z, meters. Equirectangular pictures have distances
    /// instead. The value is 0 for pixels without a surface. The array is empty without
    /// [`RenderRequest::depth`].
    pub depth_m: Vec<f32>,
}

impl Picture {
    /// The buffers to read back for a rendered picture. Depths are included only if requested.
    pub(crate) fn buffers<'a>(
        size_px: [u32; 2],
        pixels: &'a Buffer,
        depths: Option<&'a Buffer>,
    ) -> Vec<(&'a Buffer, usize)> {
        let n_bytes = 4 * size_px[0] as usize * size_px[1] as usize;
        std::iter::once(pixels)
            .chain(depths)
            .map(|buffer| (buffer, n_bytes))
            .collect()
    }

    /// Assembles the picture from the data read back from [`Self::buffers`].
    pub(crate) fn from_parts(size_px: [u32; 2], parts: &[&[u8]]) -> Self {
        let depth_m = parts
            .get(1)
            .map_or(Vec::new(), |bytes| bytemuck::pod_collect_to_vec(bytes));
        Self {
            size_px,
            rgba_srgb: parts[0].to_vec(),
            depth_m,
        }
    }

    /// A picture that shows only the background.
    pub(crate) fn empty(size_px: [u32; 2], background_srgb: [f32; 3], depth: bool) -> Self {
        let n = size_px[0] as usize * size_px[1] as usize;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "clamped to 0 to 255"
        )]
        let [red, green, blue] =
            background_srgb.map(|part| (part.clamp(0.0, 1.0) * 255.0 + 0.5).floor() as u8);
        // Alpha is coverage, which is 0 here.
        Self {
            size_px,
            rgba_srgb: [red, green, blue, 0].repeat(n),
            depth_m: vec![0.0; if depth { n } else { 0 }],
        }
    }
}
