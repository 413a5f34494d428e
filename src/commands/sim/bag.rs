//! The images of a recording as files of a RealSense camera.

use crate::config::{Camera, CameraDriver, Rig};
use crate::open;
use crate::print;
use anyhow::Context;
use drivers::realsense::Pace;
use drivers::realsense::played::{BagWriter, PlayedCamera, PlayedDepth};
use drivers::{Image, PixelFormat, Sample};
use kinematics::Stamp;
use std::path::{Path, PathBuf};

/// A camera of the rig, and its file once its first images told what they are.
struct Film<'a> {
    camera: &'a Camera,
    path: PathBuf,
    /// Colour and depth that came before the other was seen.
    waiting: Vec<Image>,
    writer: Option<BagWriter>,
}

/// Writes a file for each RealSense camera of the rig, and has the rig play it.
pub(super) fn write(
    rig: &mut Rig,
    recording: &Path,
    secs: f64,
    folder: &Path,
    as_json: bool,
) -> anyhow::Result<Vec<String>> {
    let is_its = |camera: &&Camera| camera.driver == CameraDriver::Realsense;
    let path = |camera: &Camera| folder.join(format!("{}.bag", camera.name));
    let mut films: Vec<_> = rig
        .cameras
        .iter()
        .filter(is_its)
        .map(|camera| Film { camera, path: path(camera), waiting: Vec::new(), writer: None })
        .collect();
    if films.is_empty() {
        return Ok(Vec::new());
    }
    let mut source = open::recording(recording, None, &[])?.source;
    let bar = print::bar(None, "{spinner} {elapsed} {msg}", as_json);
    let mut first: Option<Stamp> = None;
    while let Some(sample) = source.next_sample()? {
        let since = sample.stamp().secs_since(*first.get_or_insert(sample.stamp()));
        if since > secs {
            break;
        }
        if let Sample::Image(image) = sample
            && let Some(film) = films.iter_mut().find(|film| film.camera.name == image.camera)
        {
            film.take(image)?;
            bar.set_message(format!("{since:.1} of {secs:.1} s of images written"));
        }
    }
    bar.finish_and_clear();
    let told = films.iter().map(|film| format!("camera {:?}: {}", film.camera.name, film.path.display())).collect();
    films.into_iter().try_for_each(Film::finish)?;
    for camera in rig.cameras.iter_mut().filter(|camera| camera.driver == CameraDriver::Realsense) {
        camera.realsense.file = std::path::absolute(path(camera)).context("the folder of the cameras' files")?;
        camera.realsense.pace = Pace::Clock;
    }
    Ok(told)
}

impl Film<'_> {
    fn take(&mut self, image: Image) -> anyhow::Result<()> {
        let image = if image.is_depth() {
            image
        } else {
            // What a camera sends is never compressed as recordings are.
            Image { data: image.decode_rgb()?.into(), format: PixelFormat::Rgb8, ..image }
        };
        match &mut self.writer {
            Some(writer) => writer.write(&image)?,
            None => {
                self.waiting.push(image);
                self.begin()?;
            }
        }
        Ok(())
    }

    /// Begins the file as soon as an image of each kind has come.
    fn begin(&mut self) -> anyhow::Result<()> {
        let Camera { name, rate_hz, intrinsics, depth, .. } = self.camera;
        let counts = self.waiting.iter().find_map(|image| match image.format {
            PixelFormat::DepthU16 { metres_per_count } => Some(metres_per_count),
            _ => None,
        });
        let has_color = self.waiting.iter().any(|image| !image.is_depth());
        let depth = match (depth, counts) {
            (Some(depth), Some(metres_per_count)) => Some(PlayedDepth {
                intrinsics: depth.intrinsics.clone(),
                camera_from_depth: depth.camera_from_depth,
                metres_per_count,
            }),
            (Some(_), None) => return Ok(()),
            (None, _) => None,
        };
        if !has_color {
            return Ok(());
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "rates are small numbers above 0")]
        let rate_hz = rate_hz.round().max(1.0) as u16;
        let played = PlayedCamera {
            name: "fieldrig simulated camera".to_owned(),
            serial: format!("sim-{name}"),
            rate_hz,
            intrinsics: intrinsics.clone(),
            format: PixelFormat::Rgb8,
            depth,
        };
        let mut writer = BagWriter::create(&self.path, &played)?;
        self.waiting.drain(..).try_for_each(|image| writer.write(&image))?;
        self.writer = Some(writer);
        Ok(())
    }

    fn finish(self) -> anyhow::Result<()> {
        let name = &self.camera.name;
        let writer =
            self.writer.with_context(|| format!("the recording holds too few images of the camera {name:?}"))?;
        Ok(writer.finish()?)
    }
}
