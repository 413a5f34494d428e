//! Photographs of a target that are taken while a person moves the target, or an arm moves the
//! camera. A photograph is taken if the target is still and sharp and adds to the coverage. The
//! page shows what is missing. Photographs end when everything is covered.

use crate::host::{Activity, CameraView, Host};
use crate::images::{self, DetectedImage, NoBoard};
use crate::lens_devices::{self, LensDevices};
use crate::outputs::{InputKind, RigOptions, RigOutput};
use crate::photograph_quality::{is_sharp, motion_px};
use crate::saved_images::SavedImages;
use crate::scan::{MAX_SHIFT_PX, Scan, ScanOptions};
use calibration::{BoardView, LensCoverage};
use capture::config::{ArmDriver, Camera, Override, Rig};
use capture::open::Devices;
use capture::open::approximate_intrinsics;
use capture::{CalibrationImage, CalibrationImages, chosen_calibration_images};
use drivers::Sample;
use kinematics::Stamp;
use report::calibration_report::{Photo, Photos};
use std::cell::RefCell;
use std::ops::ControlFlow;
use std::path::Path;
use targets::TargetSpec;

/// Time after which photographs end even if they do not cover everything, seconds. Following all
/// instructions takes one to two minutes.
const MAX_SECS: f64 = 600.0;
/// Maximum motion of the corners while an image is read out, pixels. A rolling shutter distorts the
/// target by the same distance.
const MAX_ROLLING_PX: f64 = 1.0;
/// Readout time of cameras whose rig file has none, seconds. Rolling shutters of webcams take most
/// of a frame period.
const DEFAULT_READOUT_SECS: f64 = 0.03;
/// The motion between two images is computed if the time between them is at most this number of
/// frame periods. The next constant is a lower limit of this time, for cameras whose images are
/// searched slowly.
const MAX_PERIODS: f64 = 2.5;
const MIN_COMPARED_SECS: f64 = 0.5;
/// Time for which a remark about an image stays, seconds. Remarks that alternate faster cannot be
/// read.
const REMARK_SECS: f64 = 1.0;
/// Maximum number of images without the target that are kept to explain why there are no
/// photographs.
const MAX_FAILURES: usize = 5;

/// Why an image was not taken as a photograph, although it shows the target.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Remark {
    Moving,
    Blurred,
    NothingNew,
}

impl Remark {
    fn text(self) -> &'static str {
        match self {
            Self::Moving => "hold the target still",
            Self::Blurred => "the target is blurred: more light or a shorter exposure helps",
            Self::NothingNew => "this view is covered",
        }
    }
}

/// Decides which images become photographs, and shows what is missing.
struct Guide<'a> {
    target: &'a TargetSpec,
    coverage: LensCoverage,
    shown: Box<dyn CameraView>,
    /// Whether the arm moves the camera. Images during fast motions of the arm are left out, so the
    /// motion between the remaining images is not meaningful.
    is_carried: bool,
    readout_secs: f64,
    max_compared_secs: f64,
    /// The target in the image before, and its time.
    previous: Option<(f64, BoardView)>,
    taken: Vec<DetectedImage>,
    failures: Vec<DetectedImage>,
    saved: Option<SavedImages>,
    /// The error of saving a photograph.
    save_error: Option<anyhow::Error>,
    /// The text that is shown, and the time at which its remark was made.
    text: String,
    remarked_secs: f64,
}

impl<'a> Guide<'a> {
    fn new(
        target: &'a TargetSpec,
        camera: &Camera,
        is_carried: bool,
        shown: Box<dyn CameraView>,
        saved: Option<SavedImages>,
    ) -> Self {
        let period_secs = 1.0 / camera.rate_hz;
        let readout_secs = camera
            .readout_micros
            .map_or(DEFAULT_READOUT_SECS.min(period_secs), |micros| {
                1e-6 * micros
            });
        let mut guide = Self {
            target,
            coverage: LensCoverage::new(&approximate_intrinsics(camera)),
            shown,
            is_carried,
            readout_secs,
            max_compared_secs: (MAX_PERIODS * period_secs).max(MIN_COMPARED_SECS),
            previous: None,
            taken: Vec::new(),
            failures: Vec::new(),
            saved,
            save_error: None,
            text: String::new(),
            remarked_secs: f64::NEG_INFINITY,
        };
        guide.show_progress();
        guide
    }

    /// Decides about an image. Returns whether it is a photograph.
    fn judge(&mut self, image: &CalibrationImage) -> bool {
        if self.coverage.is_enough() {
            return false;
        }
        let detected = images::detect_in_image(image, self.target);
        let view = match &detected.board {
            Ok(board) => board.view.clone(),
            Err(reason) => {
                self.miss(image.secs, reason);
                self.failures.push(detected);
                let n_old = self.failures.len().saturating_sub(MAX_FAILURES);
                self.failures.drain(..n_old);
                return false;
            }
        };
        let remark = self.remark(image, &view);
        self.previous = Some((image.secs, view.clone()));
        if let Some(remark) = remark {
            self.show_remark(image.secs, remark.text());
            return false;
        }
        self.save(image);
        self.shown
            .show_searched(image.size_px, &image.gray, Some(&view));
        self.coverage.add(&view);
        self.taken.push(detected);
        self.show_progress();
        true
    }

    /// Saves a photograph, if this was requested. After an error, no more photographs are saved,
    /// but the lens is calibrated.
    fn save(&mut self, image: &CalibrationImage) {
        if let Some(saved) = &mut self.saved
            && let Err(error) = saved.save(image.size_px, &image.gray)
        {
            log::error!("{error:#}; the next photographs are not saved");
            self.save_error.get_or_insert(error);
            self.saved = None;
        }
    }

    /// The reason why an image that shows the target is not taken as a photograph. `None` if it is
    /// taken.
    fn remark(&self, image: &CalibrationImage, view: &BoardView) -> Option<Remark> {
        // An image that adds nothing needs no other remark, because the target has to be moved.
        if self.coverage.value_of(view).is_none() {
            return Some(Remark::NothingNew);
        }
        if !self.is_carried && !self.is_still(image.secs, view) {
            return Some(Remark::Moving);
        }
        (!is_sharp(image.size_px, &image.gray, view)).then_some(Remark::Blurred)
    }

    /// Whether the target moves slowly, compared with the image before.
    fn is_still(&self, secs: f64, view: &BoardView) -> bool {
        let Some((before_secs, before)) = &self.previous else {
            return false;
        };
        let elapsed_secs = secs - before_secs;
        if !(0.0..=self.max_compared_secs).contains(&elapsed_secs) || elapsed_secs == 0.0 {
            return false;
        }
        // With a global shutter, only the exposure blurs the image, which `is_sharp` detects.
        // Without the minimum, a moving target would be accepted as still.
        const MIN_EXPOSED_SECS: f64 = 0.005;
        let exposed_secs = self.readout_secs.max(MIN_EXPOSED_SECS);
        motion_px(before, view)
            .is_some_and(|motion_px| motion_px / elapsed_secs * exposed_secs <= MAX_ROLLING_PX)
    }

    fn show_live(&mut self, sample: &Sample) {
        if let Sample::Image(image) = sample {
            self.shown.show_live(image);
        }
    }

    /// Shows what is covered and what is missing.
    fn show_progress(&mut self) {
        self.shown.show_coverage(&self.coverage);
        let text = self.progress();
        self.show_text(text);
    }

    fn progress(&self) -> String {
        let next = self.coverage.next();
        match self.coverage.n_images() {
            0 => next.to_string(),
            n => {
                let percent = 100.0 * self.coverage.covered_frac();
                let images = messages::counted(n as u64, "photograph");
                let so_far = format!("{images}, {percent:.0} % of the image covered");
                if self.coverage.is_enough() {
                    format!("{so_far}; {next}")
                } else {
                    format!("{so_far}; next: {next}")
                }
            }
        }
    }

    /// Shows why the target was not found, unless it was found shortly before.
    fn miss(&mut self, secs: f64, reason: &NoBoard) {
        self.show_remark(secs, &reason.to_string());
    }

    /// Shows a remark after the instruction, unless another remark was made just before.
    fn show_remark(&mut self, secs: f64, remark: &str) {
        if secs - self.remarked_secs < REMARK_SECS {
            return;
        }
        let text = format!("{} ({remark})", self.progress());
        if text != self.text {
            self.remarked_secs = secs;
            self.show_text(text);
        }
    }

    fn show_text(&mut self, text: String) {
        if text != self.text {
            self.shown.advise(&text);
            self.text = text;
        }
    }
}

impl RigOptions {
    /// Takes photographs with the devices of a rig until they cover what the calibration of a lens
    /// needs. Returns `None` if the input is not a rig file, or if the user has set the duration.
    ///
    /// * `output`: gets the calibration that devices report.
    /// * `save`: folder for the photographs.
    pub(crate) fn take_photographs(
        &self,
        input: &Path,
        target: &TargetSpec,
        options: ScanOptions<'_>,
        output: Option<&mut RigOutput>,
        save: Option<&Path>,
    ) -> anyhow::Result<Option<Scan>> {
        self.check(input)?;
        if InputKind::of(input) != InputKind::Rig || self.seconds.is_some() {
            return Ok(None);
        }
        session::expect(input)?;
        let saved = save.map(SavedImages::create).transpose()?;
        let devices = self.open_for_lens(input, target)?;
        // The calibration that a simulated camera reports is not the calibration of the real
        // camera.
        if let Some(output) = output.filter(|_| !self.sim) {
            output.set_rig(&devices.rig);
        }
        let rig = devices.rig.clone();
        let camera = self.camera_of(&rig)?.clone();
        let (found, guide) = photographs(devices, &camera, target, options.host, saved)?;
        if let Some(saved) = &guide.saved {
            saved.report();
        }
        log::info!(
            "{} of {} taken",
            messages::counted(found.images.len() as u64, "photograph"),
            messages::counted(found.n_read as u64, "image")
        );
        if !guide.coverage.is_enough() && !guide.taken.is_empty() {
            log::warn!(
                "the photographs do not cover everything, so the lens is less certain; missing: {}",
                guide.coverage.next()
            );
        }
        let no_images = (found.n_read == 0).then(|| {
            format!(
                "{}: camera {:?} has sent no image",
                input.display(),
                camera.name
            )
        });
        let mut scan = scan(rig, camera, found, guide, options.keeps_photos)?;
        scan.no_images = no_images;
        Ok(Some(scan))
    }

    fn open_for_lens(&self, rig_file: &Path, target: &TargetSpec) -> anyhow::Result<LensDevices> {
        // In lockstep, the result does not depend on the speed of this computer.
        let overrides = if self.sim {
            vec![
                Override::new("sim.lockstep", true),
                Override::new("sim.truth", false),
            ]
        } else {
            Vec::new()
        };
        let rig = Rig::load(rig_file, &overrides)?;
        let camera = self.camera_of(&rig)?.name.to_string();
        let devices = if self.sim {
            Devices::Sim
        } else {
            Devices::Real
        };
        lens_devices::open(rig, &camera, target, devices)
    }
}

/// Reads the devices until everything is covered, the time is over, or a stop is requested.
fn photographs<'a>(
    devices: LensDevices,
    camera: &Camera,
    target: &'a TargetSpec,
    host: &dyn Host,
    saved: Option<SavedImages>,
) -> anyhow::Result<(CalibrationImages, Guide<'a>)> {
    let activity = Activity::ReadImages;
    let stop = host.stop_requests(activity)?;
    let view = host.open_view(camera, activity)?;
    let is_carried = devices.opened.rig.arm.driver != ArmDriver::None;
    let guide = RefCell::new(Guide::new(target, camera, is_carried, view, saved));
    let mut first: Option<Stamp> = None;
    let found = chosen_calibration_images(
        devices.opened,
        &camera.name,
        MAX_SHIFT_PX,
        |sample, _| {
            let mut guide = guide.borrow_mut();
            guide.show_live(sample);
            // The time is measured by stamps, because a simulation does not run in real time.
            let since_first = sample
                .stamp()
                .secs_since(*first.get_or_insert(sample.stamp()));
            if guide.coverage.is_enough() || since_first > MAX_SECS || stop.requested() {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        },
        &mut |image| guide.borrow_mut().judge(image),
    )?;
    let mut guide = guide.into_inner();
    guide.shown.finish();
    Ok((found, guide))
}

/// The photographs as a scan. Without photographs, the scan contains images that do not show the
/// target.
fn scan(
    rig: Rig,
    camera: Camera,
    found: CalibrationImages,
    guide: Guide<'_>,
    keeps_photos: bool,
) -> anyhow::Result<Scan> {
    let mut photos = Photos::new();
    let mut images = Vec::new();
    for (image, detected) in found.images.into_iter().zip(guide.taken) {
        if keeps_photos {
            let photo = Photo::Gray {
                size_px: image.size_px,
                pixels: image.gray,
            };
            photos.insert(detected.name.clone(), photo);
        }
        images.push((detected, image.arm));
    }
    if images.is_empty() {
        images.extend(guide.failures.into_iter().map(|failure| (failure, None)));
    }
    let mut scan = Scan::new(rig, camera, images, photos)?;
    scan.save_error = guide.save_error;
    Ok(scan)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
    use std::rc::Rc;
    use targets::GrayImage;

    const SIZE_PX: [u32; 2] = [640, 480];

    /// What a user sees.
    #[derive(Clone, Default)]
    struct Seen(Rc<RefCell<Vec<String>>>);

    impl CameraView for Seen {
        fn show_live(&mut self, _image: &drivers::Image) {}
        fn show_searched(&mut self, _size_px: [u32; 2], _gray: &[u8], _view: Option<&BoardView>) {}
        fn show_coverage(&mut self, coverage: &LensCoverage) {
            let n = coverage.n_images();
            self.0.borrow_mut().push(format!("coverage of {n}"));
        }
        fn advise(&mut self, text: &str) {
            self.0.borrow_mut().push(text.to_owned());
        }
        fn finish(&mut self) {}
    }

    fn target() -> TargetSpec {
        "chessboard:7x5:30mm".parse().expect("a target")
    }

    fn camera() -> Camera {
        let text = "[arm]\ndriver = \"none\"\n[camera.front]\ndriver = \"v4l2\"\nsize_px = [640, 480]\nrate_hz = 10\n\
                    parent = \"base\"\nreadout_micros = 20000\n\
                    intrinsics = { focal_px = [600, 600], principal_px = [320, 240] }\n";
        let urdf = r#"<robot name="none"><link name="base"/></robot>"#;
        let rig = Rig::parse("rig.toml", text, urdf, &[]).expect("a rig");
        rig.cameras[0].clone()
    }

    /// A photograph of the target by a pinhole camera, drawn by a homography with 2 x 2 samples per
    /// pixel.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "pixels and shades that were checked or clamped"
    )]
    fn photograph(secs: f64, center_m: [f64; 3], rotation_deg: [f64; 3]) -> CalibrationImage {
        let target = target();
        let picture = target.raster(2000.0).expect("it can be drawn");
        let [low, high] = target.bounds_m();
        let middle = Vector3::new(0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), 0.0);
        let rotation: Rotation3<f64> =
            UnitQuaternion::from_scaled_axis(Vector3::from(rotation_deg).map(f64::to_radians))
                .to_rotation_matrix();
        let translation = Vector3::from(center_m) - rotation * middle;
        let columns = [
            rotation * Vector3::x(),
            rotation * Vector3::y(),
            translation,
        ];
        let calibration = Matrix3::new(600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0);
        let board_from_pixel = (calibration * Matrix3::from_columns(&columns))
            .try_inverse()
            .expect("the target is not seen from its edge");
        let shade_at = |x: f64, y: f64| {
            let point = board_from_pixel * Vector3::new(x, y, 1.0);
            let at = |axis: usize| {
                ((point[axis] / point.z - picture.origin_m[axis]) * picture.px_per_m).floor()
            };
            let [width, height] = picture.size_px.map(f64::from);
            let (column, row) = (at(0), at(1));
            if (0.0..width).contains(&column) && (0.0..height).contains(&row) {
                f64::from(picture.pixels[(row * width + column) as usize])
            } else {
                120.0 // The wall behind the target.
            }
        };
        let mut gray = Vec::new();
        for row in 0..SIZE_PX[1] {
            for column in 0..SIZE_PX[0] {
                let samples = (0..4).map(|ix| {
                    let [x, y] = [ix % 2, ix / 2].map(|step| 0.5 * (f64::from(step) + 0.5));
                    shade_at(f64::from(column) + x, f64::from(row) + y)
                });
                gray.push((0.25 * samples.sum::<f64>()).round() as u8);
            }
        }
        CalibrationImage {
            secs,
            size_px: SIZE_PX,
            gray,
            arm: None,
        }
    }

    #[test]
    fn a_photograph_is_taken_when_the_target_is_still_sharp_and_new() {
        let target = target();
        let seen = Seen::default();
        let root = tempfile::tempdir().expect("a folder");
        let folder = root.path().join("photographs");
        let saved = SavedImages::create(&folder).expect("a new folder");
        let mut guide = Guide::new(
            &target,
            &camera(),
            false,
            Box::new(seen.clone()),
            Some(saved),
        );
        let center = [0.0, 0.0, 0.6];
        let first = photograph(0.0, center, [0.0; 3]);
        assert!(
            images::detect_in_image(&first, &target).board.is_ok(),
            "the drawing shows the target"
        );
        assert!(!guide.judge(&first), "nothing is known about its motion");
        assert!(
            guide.judge(&photograph(0.1, center, [0.0; 3])),
            "it is still"
        );
        assert!(
            !guide.judge(&photograph(0.2, center, [0.0; 3])),
            "it is the same view"
        );
        let tilt = [0.0, 30.0, 0.0];
        // 12 mm per 0.1 s are 12 px, or 2.4 px during the readout.
        assert!(!guide.judge(&photograph(0.3, [-0.012, 0.0, 0.6], tilt)));
        assert!(
            !guide.judge(&photograph(0.4, [0.0, 0.0, 0.6], tilt)),
            "it moves"
        );
        assert!(guide.judge(&photograph(0.5, [0.0, 0.0, 0.6], tilt)));
        // The images before a pause are not compared with the images after it.
        let other = [0.0, -30.0, 0.0];
        assert!(!guide.judge(&photograph(9.0, center, other)));
        let blurred = blurred(&photograph(9.1, center, other));
        assert!(!guide.judge(&blurred), "it is blurred");
        assert!(guide.judge(&photograph(9.2, center, other)));

        assert_eq!(images::files(&folder).expect("images").len(), 3);
        let seen = seen.0.borrow();
        for words in [
            "show the whole target to the camera",
            "(hold the target still)",
            "1 photograph, ",
            "3 photographs, ",
            "next: tilt the target by 20 to 45 degrees, with its left side",
            "coverage of 3",
        ] {
            assert!(
                seen.iter().any(|text| text.contains(words)),
                "{words}: {seen:?}"
            );
        }
    }

    /// The mean over 15 x 15 pixels.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "pixels and shades that were clamped"
    )]
    fn blurred(image: &CalibrationImage) -> CalibrationImage {
        let [width, height] = SIZE_PX.map(i64::from);
        let mut gray = Vec::new();
        for row in 0..height {
            for column in 0..width {
                let mut sum = 0;
                for y in row - 7..=row + 7 {
                    let x = column.clamp(0, width - 1);
                    sum += i64::from(image.gray[(y.clamp(0, height - 1) * width + x) as usize]);
                }
                gray.push((sum / 15) as u8);
            }
        }
        let rows = gray;
        let mut gray = Vec::new();
        for row in 0..height {
            for column in 0..width {
                let sum: i64 = (column - 7..=column + 7)
                    .map(|x| i64::from(rows[(row * width + x.clamp(0, width - 1)) as usize]))
                    .sum();
                gray.push((sum / 15) as u8);
            }
        }
        CalibrationImage {
            gray,
            ..image.clone()
        }
    }

    #[test]
    fn without_the_target_the_reason_is_shown_and_kept() {
        let target = target();
        let seen = Seen::default();
        let mut guide = Guide::new(&target, &camera(), false, Box::new(seen.clone()), None);
        for ix in 0..10 {
            let empty = CalibrationImage {
                secs: f64::from(ix),
                size_px: SIZE_PX,
                gray: vec![120; 640 * 480],
                arm: None,
            };
            assert!(!guide.judge(&empty));
        }
        assert_eq!(guide.failures.len(), MAX_FAILURES);
        let empty = GrayImage {
            size_px: SIZE_PX,
            pixels: &[120; 640 * 480],
        };
        let reason = target.detect(empty).expect_err("there is none").to_string();
        assert!(seen.0.borrow().iter().any(|text| text.contains(&reason)));
    }
}
