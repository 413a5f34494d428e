//! Renders views of a TSDF model.

use super::TsdfModel;
use super::frustum::ViewFrustum;
use crate::packing::Output;
use crate::tsdf::chosen_grid::VoxelGrid;
use crate::tsdf::passes::{self, Canvas};
use crate::view::Camera;
use crate::{Error, Projection, RenderRequest, Rendered};

impl TsdfModel {
    /// Renders one pinhole view.
    pub(super) fn draw_view(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        output: Output,
    ) -> Result<Option<Rendered>, Error> {
        if !self.record_picture(camera, background_srgb)? {
            return Ok(Rendered::empty(camera.size_px, background_srgb, output));
        }
        let canvas = self
            .canvas
            .as_ref()
            .ok_or_else(|| Error::internal("the canvas of a picture is missing"))?;
        let canvas = [&canvas.pixels, &canvas.depths];
        self.reader
            .read(&self.gpu, &mut self.passes, output, camera.size_px, canvas)
    }

    /// Renders a pinhole view without reading it back, and returns its GPU time in milliseconds.
    /// Returns `None` if the projection is not a pinhole, the model is empty, or the adapter has no
    /// timestamps.
    pub fn profile_picture(&mut self, request: &RenderRequest) -> Result<Option<f64>, Error> {
        self.finish_in_flight()?;
        let Projection::Pinhole {
            focal_px,
            principal_px,
        } = request.projection
        else {
            return Ok(None);
        };
        if !self.record_picture(
            &Camera::from_request(request, focal_px, principal_px),
            request.background_srgb,
        )? {
            return Ok(None);
        }
        Ok(self.passes.submit_timed_total(&self.gpu)?)
    }

    /// Records the passes of a picture. Returns false if there is nothing to render.
    fn record_picture(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
    ) -> Result<bool, Error> {
        let [width, height] = camera.size_px;
        let n = u64::from(width) * u64::from(height);
        let Some(store) = &mut self.store else {
            return Ok(false);
        };
        let in_field = in_field(camera, &store.voxel_grid);
        let frustum = ViewFrustum::of_camera(&in_field, &store.voxel_grid);
        // Blocks in host memory that the view shows are loaded. If not all blocks fit, a picture
        // without the farthest blocks is better than no picture.
        store.load_visible(&self.gpu, &self.pipelines, &frustum, true)?;
        if self
            .canvas
            .as_ref()
            .is_none_or(|canvas| canvas.n_pixels < n)
        {
            // The smaller buffer is freed before the larger buffer is allocated.
            self.passes.clear_bindings();
            self.canvas = None;
        }
        let canvas = match self.canvas.take() {
            Some(canvas) => canvas,
            None => Canvas::new(&self.gpu, n)?,
        };
        canvas.set_view(&self.gpu, &in_field.view(), background_srgb);
        let erased = self.erased.set(
            &self.gpu,
            &mut self.passes,
            &camera.edits,
            store.voxel_grid.world_from_voxels(),
        )?;
        let drawn = (&canvas, erased);
        passes::draw(
            &self.gpu,
            &mut self.passes,
            &self.pipelines,
            &store.buffers,
            drawn,
            camera.size_px,
        );
        self.canvas = Some(canvas);
        Ok(true)
    }
}

/// The camera and its crop box in the field's frame.
fn in_field(camera: &Camera, voxel_grid: &VoxelGrid) -> Camera {
    let field_from_world = voxel_grid.field_from_world();
    let mut camera = camera.clone();
    camera.world_from_camera = field_from_world * camera.world_from_camera;
    if let Some(crop) = &mut camera.crop {
        crop.world_from_box = field_from_world * crop.world_from_box;
    }
    camera
}
