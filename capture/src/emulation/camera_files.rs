//! Writes the images of a recording to RealSense bag files.

use crate::config::{Camera, CameraDriver, Rig};
use anyhow::Context;
use drivers::realsense::Pace;
use drivers::realsense::emulated::{BagWriter, EmulatedCamera, EmulatedDepth};
use drivers::{Image, PixelFormat};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The bag files of a rig's cameras while they are written.
pub(super) struct CameraFiles {
    camera_files: Vec<CameraFile>,
}

/// A camera of the rig. Its file is created once the first images define its format.
struct CameraFile {
    camera: Camera,
    path: PathBuf,
    /// Color and depth images received before the file is created.
    pending: Vec<Image>,
    writer: Option<BagWriter>,
}

impl CameraFiles {
    /// Creates an entry for each RealSense camera of the rig.
    pub(super) fn new(rig: &Rig, folder: &Path) -> anyhow::Result<Self> {
        // The path is absolute, because the rig file that names these files may be read from
        // another folder.
        let folder =
            std::path::absolute(folder).context("cannot resolve the folder of the camera files")?;
        let camera_file = |camera: &Camera| CameraFile {
            camera: camera.clone(),
            path: folder.join(format!("{}.bag", camera.name)),
            pending: Vec::new(),
            writer: None,
        };
        let is_realsense = |camera: &&Camera| camera.driver == CameraDriver::Realsense;
        Ok(Self {
            camera_files: rig
                .cameras
                .iter()
                .filter(is_realsense)
                .map(camera_file)
                .collect(),
        })
    }

    /// Adds an image. Images of other cameras are ignored.
    pub(super) fn take(&mut self, image: Image) -> anyhow::Result<()> {
        match self
            .camera_files
            // Only RealSense cameras have an entry.
            .iter_mut()
            .find(|camera_file| camera_file.camera.name == image.camera)
        {
            Some(camera_file) => camera_file.take(image),
            None => Ok(()),
        }
    }

    /// Finishes the files and sets them as the files of the rig's cameras, paced by the clock.
    /// Returns a description of each.
    pub(super) fn finish(self, rig: &mut Rig) -> anyhow::Result<Vec<String>> {
        let mut descriptions = Vec::new();
        for camera_file in self.camera_files {
            // These values are copied, because finishing consumes the entry.
            let name = Arc::clone(&camera_file.camera.name);
            let path = camera_file.path.clone();
            camera_file.finish()?;
            descriptions.push(format!("camera {name:?}: {}", path.display()));
            for camera in rig.cameras.iter_mut().filter(|camera| camera.name == name) {
                camera.realsense.file = path.clone();
                // Each image is then delivered at the time of its stamp, in step with the other
                // devices.
                camera.realsense.pace = Pace::Clock;
            }
        }
        Ok(descriptions)
    }
}

impl CameraFile {
    fn take(&mut self, image: Image) -> anyhow::Result<()> {
        let image = if image.is_depth() {
            image
        } else {
            // RealSense cameras send uncompressed images, but recordings contain compressed ones.
            Image {
                data: image.decode_rgb()?.into(),
                format: PixelFormat::Rgb8,
                ..image
            }
        };
        match &mut self.writer {
            Some(writer) => writer.write(&image)?,
            None => {
                self.pending.push(image);
                self.create_writer()?;
            }
        }
        Ok(())
    }

    /// Creates the file as soon as images of all expected kinds have arrived.
    fn create_writer(&mut self) -> anyhow::Result<()> {
        let Camera {
            name,
            rate_hz,
            intrinsics,
            depth,
            ..
        } = &self.camera;
        let meters_per_depth_count = self.pending.iter().find_map(|image| match image.format {
            PixelFormat::DepthU16 { meters_per_count } => Some(meters_per_count),
            _ => None,
        });
        let has_color = self.pending.iter().any(|image| !image.is_depth());
        let depth = match (depth, meters_per_depth_count) {
            (Some(depth), Some(meters_per_count)) => Some(EmulatedDepth {
                intrinsics: depth.intrinsics.clone(),
                camera_from_depth: depth.camera_from_depth,
                meters_per_count,
            }),
            // The file is not created yet, because the rig file has depth, and the first depth
            // image contains the unit.
            (Some(_), None) => return Ok(()),
            (None, _) => None,
        };
        // The header of the file describes all its streams, so it is written once both are known.
        if !has_color {
            return Ok(());
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "rates are small numbers above 0"
        )]
        // The file stores rates as integers. The rate is at least 1, because a slower camera would
        // otherwise get a rate of 0.
        let rate_hz = rate_hz.round().max(1.0) as u16;
        let emulated = EmulatedCamera {
            name: "fieldrig simulated camera".to_owned(),
            serial: format!("sim-{name}"),
            rate_hz,
            intrinsics: intrinsics.clone(),
            format: PixelFormat::Rgb8,
            depth,
        };
        let mut writer = BagWriter::create(&self.path, &emulated)?;
        // The waiting images come first, in the order in which they arrived.
        self.pending
            .drain(..)
            .try_for_each(|image| writer.write(&image))?;
        self.writer = Some(writer);
        Ok(())
    }

    fn finish(self) -> anyhow::Result<()> {
        let name = &self.camera.name;
        // A camera without a file sent too few images to define the format of its streams.
        let writer = self
            .writer
            .with_context(|| format!("the recording has too few images of camera {name:?}"))?;
        Ok(writer.finish()?)
    }
}
