//! Rendering of a saved model at given cameras, into files.

use crate::camera_path::{CameraPath, PathCamera};
use crate::evaluate::{covered_frac, warn_if_hardly_covered};
use crate::recoveries::OpenGpu;
use crate::run_folder::expect_model;
use crate::{methods, rendered_files};
use anyhow::Context;
use messages::{BadInput, Setting};
use model_files::Aabb;
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use trainer::{LoadedModel, Projection, RenderRequest};

/// Image size if neither the plan nor the camera path gives one.
const DEFAULT_SIZE_PX: [u32; 2] = [1280, 720];

/// Model and cameras to render, and the output folder.
#[derive(Clone, Debug)]
pub struct RenderPlan {
    /// Folder of a saved model, or a splat file.
    pub model: PathBuf,
    /// The cameras.
    pub cameras: RenderedCameras,
    /// Size of the images. `None`: the size in the camera path, or a default.
    pub size_px: Option<[u32; 2]>,
    /// Vertical field of view, degrees. `None`: the value in the camera path, or a default.
    pub fov_y_deg: Option<f64>,
    /// Whether equirectangular panoramas are rendered instead of pinhole views.
    pub is_equirectangular: bool,
    /// Lower and upper corner of the box outside of which the scene is invisible, in the world
    /// frame, meters.
    pub crop_m: Option<[[f64; 3]; 2]>,
    /// Whether depth is also written.
    pub depth: bool,
    /// Folder for the images.
    pub out: PathBuf,
}

/// Where the cameras come from.
#[derive(Clone, Debug)]
pub enum RenderedCameras {
    /// A camera path in nerfstudio's format.
    Path(PathBuf),
    /// One pose, `world_from_camera`, row major.
    Pose([f64; 16]),
}

/// A rendered image. It serializes as JSON.
#[derive(Debug, Serialize)]
pub struct RenderedPicture {
    picture: PathBuf,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth: Option<PathBuf>,
    size_px: [u32; 2],
    /// Wall time from the request to the pixels, milliseconds.
    draw_millis: f64,
}

/// Receives the number of rendered images, the number of all images, and the newest image.
pub type OnPicture<'a> =
    dyn FnMut(usize, usize, Option<&RenderedPicture>) -> anyhow::Result<()> + 'a;

impl RenderPlan {
    /// Renders every camera, and returns the number of images.
    ///
    /// * `on_picture`: called with the number of rendered images and the number of all images,
    ///   before the first image and after each image.
    ///
    /// # Errors
    /// Fails if the plan contradicts itself, if a file cannot be read or written, if a file exists,
    /// or with the error of `on_picture`.
    pub fn run(&self, open_gpu: OpenGpu, on_picture: &mut OnPicture<'_>) -> anyhow::Result<usize> {
        // Everything that can be refused is checked before the GPU is opened and the model is
        // loaded.
        let requests = self.requests()?;
        expect_model(&self.model)?;
        capture::check_output_folder(Setting::Out, &self.out)?;
        rendered_files::check_no_overwrite(&self.out, requests.len())?;
        let loaded = methods::load(open_gpu()?, &self.model)?;
        let is_empty = methods::note_if_empty(&self.model, &loaded).is_some();
        let LoadedModel {
            method: mut model,
            edits,
            ..
        } = loaded;
        // All requests share the edits, because a model may have many of them.
        let edits = Arc::new(edits);
        std::fs::create_dir_all(&self.out)
            .with_context(|| format!("cannot create the folder {}", self.out.display()))?;
        on_picture(0, requests.len(), None)?;
        let mut covered_fracs = Vec::new();
        for (ix, request) in requests.iter().enumerate() {
            // Only the request is timed, because encoding and writing files are not part of
            // drawing.
            let since = Instant::now();
            let picture = model.model_mut().render(&RenderRequest {
                edits: Arc::clone(&edits),
                ..request.clone()
            })?;
            let draw_millis = since.elapsed().as_secs_f64() * 1e3;
            covered_fracs.push(covered_frac(&picture));
            let (picture, depth) = rendered_files::write(&self.out, ix, &picture, self.depth)?;
            let rendered = RenderedPicture {
                picture,
                depth,
                size_px: request.size_px,
                draw_millis,
            };
            on_picture(ix + 1, requests.len(), Some(&rendered))?;
        }
        // An empty model has a separate note.
        if !is_empty {
            warn_if_hardly_covered(&covered_fracs);
        }
        Ok(requests.len())
    }

    /// One request for each camera.
    fn requests(&self) -> anyhow::Result<Vec<RenderRequest>> {
        let path = match &self.cameras {
            RenderedCameras::Path(file) => CameraPath::load(file)?,
            RenderedCameras::Pose(pose) => CameraPath::of_pose(pose)?,
        };
        for note in &path.notes {
            log::warn!("{}: {note}", Setting::CameraPath);
        }
        if path.is_panoramic && !self.is_equirectangular {
            return Err(BadInput(format!(
                "{}: the path was made for panoramas; add {}",
                Setting::CameraPath,
                Setting::Equirect
            ))
            .into());
        }
        let size_px = self.size_px.or(path.size_px).unwrap_or(DEFAULT_SIZE_PX);
        let requests = path
            .cameras
            .iter()
            .map(|camera| self.request(camera, size_px));
        Ok(requests.collect::<Result<_, _>>()?)
    }

    fn request(&self, camera: &PathCamera, size_px: [u32; 2]) -> Result<RenderRequest, BadInput> {
        const DEFAULT_FOV_DEGREES: f64 = 60.0;
        let fov_y_rad = self
            .fov_y_deg
            .map(f64::to_radians)
            .or(camera.fov_y_rad)
            .unwrap_or(DEFAULT_FOV_DEGREES.to_radians());
        if !(fov_y_rad > 0.0 && fov_y_rad < std::f64::consts::PI) {
            return Err(BadInput(format!(
                "field of view {} degrees: must be above 0 and below 180",
                fov_y_rad.to_degrees()
            )));
        }
        let [width, height] = size_px.map(f64::from);
        let focal_px = 0.5 * height / (0.5 * fov_y_rad).tan();
        let pinhole = Projection::Pinhole {
            focal_px: [focal_px; 2],
            principal_px: [0.5 * width, 0.5 * height],
        };
        Ok(RenderRequest {
            world_from_camera: camera.world_from_camera,
            size_px,
            projection: if self.is_equirectangular {
                Projection::Equirectangular
            } else {
                pinhole
            },
            shutter: None,
            near_m: 0.01,
            far_m: 1000.0,
            crop: self.crop_m.map(|[min_m, max_m]| Aabb {
                world_from_box: kinematics::Transform::identity(),
                min_m,
                max_m,
            }),
            edits: Arc::default(),
            background_srgb: [0.0; 3],
            appearance_of: None,
            depth: self.depth,
        })
    }
}
