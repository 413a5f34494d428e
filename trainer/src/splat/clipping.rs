//! Buffers and pipelines that limit pictures to a crop box, and cut erased space out of them.

use super::kernels::ClipPipelines;
use super::params::Camera;
use crate::Error;
use crate::view::ErasedSpace;
use gpu::{Buffer, Gpu, Passes};
use nalgebra::Matrix4;

/// Size of `Clip` in `shared/splat_clip.wgsl`.
pub(crate) const CLIP_BYTES: u64 = 48;

/// Prepares to clip the splats of pictures. Pipelines and buffers are created for the first picture
/// that needs them.
#[derive(Debug)]
pub(crate) struct Clipper {
    erased: ErasedSpace,
    pipelines: Option<ClipPipelines>,
    clips: Option<Buffer>,
}

/// The buffers and pipelines with which the passes of a picture clip its splats.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Clipping<'a> {
    pub(crate) pipelines: &'a ClipPipelines,
    pub(crate) erased: &'a Buffer,
    /// `Clip` of each splat.
    pub(crate) clips: &'a Buffer,
}

impl Clipping<'_> {
    /// The buffers, with their binding names in the kernels.
    pub(crate) fn buffers(&self) -> [(&'static str, &Buffer); 2] {
        [("erased", self.erased), ("clips", self.clips)]
    }
}

impl Clipper {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, Error> {
        Ok(Self {
            erased: ErasedSpace::none(gpu)?,
            pipelines: None,
            clips: None,
        })
    }

    /// Prepares a picture of up to `n_splats` splats. Returns `None` if nothing is clipped.
    pub(crate) fn prepare(
        &mut self,
        gpu: &Gpu,
        passes: &mut Passes,
        camera: &Camera,
        n_splats: u32,
    ) -> Result<Option<Clipping<'_>>, Error> {
        if camera.crop.is_none() && camera.edits.is_empty() {
            return Ok(None);
        }
        let pipelines = match self.pipelines.take() {
            Some(pipelines) => pipelines,
            None => ClipPipelines::new(gpu)?,
        };
        let n_bytes = CLIP_BYTES * u64::from(n_splats);
        let clips = match self.clips.take().filter(|clips| clips.bytes() >= n_bytes) {
            Some(clips) => clips,
            None => {
                // Cached bindings hold the previous buffer. Without this call, the previous buffer
                // would not be freed.
                passes.clear_bindings();
                gpu.storage("splat.clips", n_bytes)?
            }
        };
        Ok(Some(Clipping {
            pipelines: self.pipelines.insert(pipelines),
            erased: self
                .erased
                .set(gpu, passes, &camera.edits, Matrix4::identity())?,
            clips: self.clips.insert(clips),
        }))
    }
}
