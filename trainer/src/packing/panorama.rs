//! Panoramas. The six faces of a cube are drawn as pinhole views and copied into one
//! equirectangular picture on the GPU.

use super::kernel;
use crate::view::{Camera, LOW_PASS_PX2};
use crate::{Error, RenderRequest};
use gpu::{Buffer, Gpu, Passes, Pipeline};
use kinematics::Transform;
use nalgebra::{Rotation3, Translation3, UnitQuaternion, Vector3};
use numbers::f32s_of;
use std::f64::consts::{FRAC_PI_2, PI};
use std::sync::Arc;

/// Number of faces.
const N_FACES: usize = 6;

/// A face of the cube around the camera of a panorama.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Face {
    /// Width and height of the panorama, pixels.
    pub(crate) panorama_px: [u32; 2],
    ix: usize,
}

impl Face {
    /// All faces, in the order in which they are drawn.
    pub(crate) fn all(panorama_px: [u32; 2]) -> impl Iterator<Item = Self> {
        (0..N_FACES).map(move |ix| Self { panorama_px, ix })
    }

    /// Whether the panorama is complete after this face.
    pub(crate) fn is_last(self) -> bool {
        self.ix + 1 == N_FACES
    }

    /// Width and height of a face, pixels. Along the lines through its middle, a face covers a
    /// quarter of the panorama's width and half of its height.
    fn edge_px(self) -> u32 {
        let [width, height] = self.panorama_px;
        (width / 4).max(height / 2).max(1)
    }

    fn rotation(self) -> Rotation3<f64> {
        let about = |axis, angle| Rotation3::from_axis_angle(&axis, angle);
        // The faces are forward, right, back and left, then up and down. In each face, x is right
        // and y is down.
        match self.ix {
            0 => Rotation3::identity(),
            1 => about(Vector3::y_axis(), FRAC_PI_2),
            2 => about(Vector3::y_axis(), PI),
            3 => about(Vector3::y_axis(), -FRAC_PI_2),
            4 => about(Vector3::x_axis(), FRAC_PI_2),
            _ => about(Vector3::x_axis(), -FRAC_PI_2),
        }
    }

    /// The camera that draws this face.
    pub(crate) fn camera(self, request: &RenderRequest) -> Camera {
        let rotation = UnitQuaternion::from_rotation_matrix(&self.rotation());
        let edge_px = self.edge_px();
        Camera {
            world_from_camera: request.world_from_camera
                * Transform::from_parts(Translation3::identity(), rotation),
            size_px: [edge_px; 2],
            // The field of view is 90 degrees, so that the six faces cover all directions.
            focal_px: [f64::from(edge_px) / 2.0; 2],
            principal_px: [f64::from(edge_px) / 2.0; 2],
            shutter: None,
            near_m: request.near_m,
            far_m: request.far_m,
            crop: request.crop,
            edits: Arc::clone(&request.edits),
            low_pass_px2: LOW_PASS_PX2,
        }
    }

    fn params(self) -> FaceParams {
        let rotation = self.rotation();
        let axis = |ix: usize| {
            let [x, y, z] = f32s_of(rotation.matrix().column(ix).into_owned().into());
            [x, y, z, 0.0]
        };
        FaceParams {
            right: axis(0),
            down: axis(1),
            forward: axis(2),
            size_px: self.panorama_px,
            edge_px: self.edge_px(),
            unused: 0,
        }
    }
}

/// `Face` of `panorama_face.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
struct FaceParams {
    right: [f32; 4],
    down: [f32; 4],
    forward: [f32; 4],
    size_px: [u32; 2],
    edge_px: u32,
    unused: u32,
}

/// A panorama on the GPU.
#[derive(Debug)]
pub(crate) struct Panorama {
    copy_face: Pipeline,
    face: Buffer,
    n_pixels: u64,
    pixels: Buffer,
    depths: Buffer,
}

impl Panorama {
    /// Records the pass that copies a face from `canvas` (pixels and depths) into the panorama,
    /// which is allocated if `panorama` is too small. Returns the panorama's pixels and depths.
    pub(super) fn record<'a>(
        panorama: &'a mut Option<Self>,
        gpu: &Gpu,
        passes: &mut Passes,
        face: Face,
        [face_pixels, face_depths]: [&Buffer; 2],
    ) -> Result<[&'a Buffer; 2], Error> {
        let n_pixels = face.panorama_px.map(u64::from).iter().product();
        if panorama
            .as_ref()
            .is_none_or(|panorama| panorama.n_pixels < n_pixels)
        {
            // The old panorama is freed before the larger panorama is allocated.
            passes.clear_bindings();
            *panorama = None;
            *panorama = Some(Self::new(gpu, n_pixels)?);
        }
        let panorama = panorama
            .as_ref()
            .ok_or_else(|| Error::internal("the panorama is missing"))?;
        let Self {
            copy_face,
            face: params,
            pixels,
            depths,
            ..
        } = panorama;
        gpu.write(params, 0, bytemuck::bytes_of(&face.params()));
        let buffers = [
            ("face", params),
            ("face_pixels", face_pixels),
            ("face_depths", face_depths),
            ("pixels", pixels),
            ("depths", depths),
        ];
        passes.dispatch(gpu, copy_face, n_pixels.div_ceil(64), &buffers);
        Ok(panorama.canvas())
    }

    fn new(gpu: &Gpu, n_pixels: u64) -> Result<Self, Error> {
        Ok(Self {
            copy_face: Pipeline::new(gpu, kernel!("panorama_face"), &[])?,
            face: gpu.uniform_with(
                "packing.face",
                &<FaceParams as bytemuck::Zeroable>::zeroed(),
            ),
            n_pixels,
            pixels: gpu.storage("packing.panorama_pixels", 4 * n_pixels)?,
            depths: gpu.storage("packing.panorama_depths", 4 * n_pixels)?,
        })
    }

    /// Pixels and depths.
    pub(super) fn canvas(&self) -> [&Buffer; 2] {
        [&self.pixels, &self.depths]
    }
}
