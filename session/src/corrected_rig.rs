//! Writes a rig file with the calibration corrections that were estimated.

use anyhow::Context;
use calibration::{Alignment, CameraCorrection, Estimate};
use capture::config::{Base, Camera, Parent, Rig, TimeOffset};
use kinematics::{Chain, Intrinsics, Stamp, Transform};
use messages::{BadInput, Setting, listed};
use nalgebra::{DMatrix, Translation3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

/// Values of `source` in a corrected time offset.
const ALIGNED: &str = "registration of keyframes";
const LEARNED: &str = "optimization with the scene";

/// The rig with the corrections of alignment, followed by the corrections that were optimized with
/// the scene. Extrinsics that were optimized with the scene are left out if alignment has estimated
/// them. Corrections of single images are left out, too, because rig files have no key for them.
pub fn corrected(
    rig: &Rig,
    alignment: Option<&Alignment>,
    learned: &BTreeMap<String, CameraCorrection>,
) -> anyhow::Result<Rig> {
    let mut rig = rig.clone();
    let unaligned = Alignment::default();
    let alignment = alignment.unwrap_or(&unaligned);
    for camera in &mut rig.cameras {
        // A rig file has one pose per camera. After a movement, the latest pose is the right one
        // for later runs.
        if let Some(correction) = alignment.movement_correction(&camera.name, Stamp(i64::MAX)) {
            correct(camera, &correction, &[], ALIGNED);
        }
        if let Some(correction) = alignment.corrections.get(&*camera.name) {
            correct(camera, correction, &alignment.estimates, ALIGNED);
        }
        if let Some(correction) = learned.get(&*camera.name) {
            let mut correction = correction.clone();
            if has_extrinsics_of(&alignment.estimates, &camera.name) {
                // Registration is more accurate: extrinsics that are optimized with an unfinished
                // scene adapt to it.
                correction.rotation_rad = [0.0; 3];
                correction.translation_m = [0.0; 3];
            } else if correction.rotation_rad != [0.0; 3] {
                log::info!(
                    "camera {:?}: corrected by {:.3} degrees and {:.2} mm, optimized with the scene",
                    &*camera.name,
                    Vector3::from(correction.rotation_rad).norm().to_degrees(),
                    1e3 * Vector3::from(correction.translation_m).norm()
                );
            }
            correct(camera, &correction, &[], LEARNED);
        }
    }
    // All cameras on the arm have the same joint offsets. Cameras that no joint carries have no
    // joint offsets, so the longest list is taken.
    let joint_offsets = alignment
        .corrections
        .values()
        .map(|correction| &correction.joint_offsets)
        .max_by_key(|offsets| offsets.len());
    if let Some(by_chain) = joint_offsets.filter(|offsets| !offsets.is_empty()) {
        let chain = Chain::from_urdf(&rig.arm.urdf_text, &rig.arm.base_link, &rig.arm.flange_link)?;
        rig.arm.joint_offsets.resize(rig.arm.joints.len(), 0.0);
        for (joint_ix, offset) in chain.order_in(&rig.arm.joints)?.into_iter().zip(by_chain) {
            rig.arm.joint_offsets[joint_ix] += offset;
        }
    }
    Ok(rig)
}

/// Whether the estimates contain the extrinsics of a camera.
fn has_extrinsics_of(estimates: &[Estimate], camera: &str) -> bool {
    estimates.iter().any(|estimate| match estimate {
        Estimate::HandEye(estimate) => *estimate.camera == *camera,
        _ => false,
    })
}

/// A camera of a rig.
///
/// # Errors
/// [`BadInput`] with the names of all cameras if none has this name.
pub fn camera<'a>(rig: &'a Rig, name: &str) -> anyhow::Result<&'a Camera> {
    rig.cameras
        .iter()
        .find(|camera| *camera.name == *name)
        .ok_or_else(|| {
            let names: Vec<&str> = rig.cameras.iter().map(|camera| &*camera.name).collect();
            BadInput(format!(
                "{} {name}: the rig file has no such camera; it has {}",
                Setting::Camera,
                listed(&names, "and")
            ))
            .into()
        })
}

/// The rig with other intrinsics of a camera. They also apply to depth images with the same lens.
///
/// * `covariance`: covariance of the intrinsics, if it is known.
///
/// # Errors
/// [`BadInput`] if there is no such camera, or if its images have another size.
pub fn with_intrinsics(
    rig: &Rig,
    name: &str,
    intrinsics: &Intrinsics,
    covariance: Option<&DMatrix<f64>>,
) -> anyhow::Result<Rig> {
    expect_size(camera(rig, name)?, intrinsics.size_px)?;
    let mut rig = rig.clone();
    for camera in rig
        .cameras
        .iter_mut()
        .filter(|camera| *camera.name == *name)
    {
        let before = std::mem::replace(&mut camera.intrinsics, intrinsics.clone());
        // The intrinsics are known now, so they are no longer read from the device.
        camera.unknown.intrinsics = false;
        // Depth of cameras that store no lenses shares the lens below.
        camera.unknown.depth_intrinsics &= camera.reports_lenses();
        // The matrix is symmetric, so the order of rows and columns does not matter.
        camera.intrinsics_covariance =
            covariance.map_or_else(Vec::new, |covariance| covariance.as_slice().to_vec());
        if let Some(depth) = &mut camera.depth
            && depth.intrinsics == before.resized(depth.intrinsics.size_px)
        {
            depth.intrinsics = intrinsics.resized(depth.intrinsics.size_px);
        }
    }
    Ok(rig)
}

/// The rig with another pose of a camera. A pose relative to a fixed base is converted if the
/// camera is attached to the world.
///
/// # Errors
/// [`BadInput`] if there is no such camera, or if it is attached to another frame than
/// `parent`.
pub fn with_extrinsics(
    rig: &Rig,
    name: &str,
    parent: Parent,
    pose: &Transform,
) -> anyhow::Result<Rig> {
    let given = camera(rig, name)?.parent;
    // Only a fixed base has one known pose in the world.
    let is_converted = (parent, given) == (Parent::Base, Parent::World) && !rig.has_moving_base();
    if given != parent && !is_converted {
        return Err(BadInput(format!(
            "{} {name}: its parent in the rig file is {}, but the calibrated pose is relative to the {}; change parent, or the setup of the calibration",
            Setting::Camera,
            given.name(),
            parent.name()
        ))
        .into());
    }
    let mut rig = rig.clone();
    let camera = rig.cameras.iter_mut().find(|camera| *camera.name == *name);
    let camera = camera.expect("checked above");
    camera.parent_from_camera = parent_from_camera(&rig.base, given, pose);
    camera.unknown.parent_from_camera = false;
    Ok(rig)
}

/// `parent_from_camera` for a camera on the flange or in a fixed base. The pose of a camera in a
/// fixed base is converted if its parent is the world.
pub fn parent_from_camera(base: &Base, parent: Parent, pose: &Transform) -> Transform {
    match parent {
        Parent::World => base.world_from_base * pose,
        Parent::Flange | Parent::Base => *pose,
    }
}

/// Checks that calibrated images have the size of a camera's images.
///
/// # Errors
/// [`BadInput`] if the sizes differ.
pub fn expect_size(camera: &Camera, [width, height]: [u32; 2]) -> anyhow::Result<()> {
    let [rig_width, rig_height] = camera.intrinsics.size_px;
    if [width, height] == camera.intrinsics.size_px {
        return Ok(());
    }
    Err(BadInput(format!(
        "{} {}: its images have {rig_width}x{rig_height} pixels in the rig file, but the calibrated images have {width}x{height}; calibrate this resolution, or change size_px",
        Setting::Camera,
        camera.name
    ))
    .into())
}

/// Checks that a rig file can be written to this path.
pub fn check_target_file(rig: &Rig, file: &Path) -> anyhow::Result<()> {
    let folder = file
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    if !folder.is_dir() || file.is_dir() {
        return Err(BadInput(format!(
            "{} {}: must be a file in an existing folder",
            Setting::WriteRig,
            file.display()
        ))
        .into());
    }
    match other_robot(rig, file) {
        Some(urdf) => Err(BadInput(format!(
            "{} {}: {} is the URDF of another robot; write the rig file to a separate folder",
            Setting::WriteRig,
            file.display(),
            urdf.display()
        ))
        .into()),
        None => Ok(()),
    }
}

/// Path of the URDF next to a rig file, if it describes another robot. A rig without a robot
/// description does not use this file.
fn other_robot(rig: &Rig, file: &Path) -> Option<PathBuf> {
    if !rig.arm.has_description() {
        return None;
    }
    let urdf = file.with_file_name(drivers::recording::URDF_FILE);
    let existing = files::read_text(&urdf).ok()?;
    (existing != rig.arm.urdf_text).then_some(urdf)
}

/// The text of a rig file to write: all keys, and the comments of the file from which the rig was
/// read. A rig that was read from elsewhere gets the comments of the file to replace.
fn text_of(rig: &Rig, file: &Path) -> String {
    let source = files::read_text(rig.path.get().unwrap_or(file));
    rig.to_toml_with_comments(&source.unwrap_or_default())
}

/// Writes a rig file atomically, and the robot's URDF next to it if the rig has one. An existing file is kept with the
/// extension `.old`, or with `.old2`, `.old3` and so on if `.old` exists. Does not overwrite the
/// URDF of another robot. If two programs write the same file at the same time, the second program
/// gets an error.
pub fn write(rig: &Rig, file: &Path) -> anyhow::Result<()> {
    check_target_file(rig, file)?;
    let linked = std::fs::read_link(file);
    let mut backup = None;
    // The previous file is copied while no other program can write it, so that the copy has the
    // latest contents.
    let written = files::replace(file, |unfinished| {
        write_urdf(rig, file)?;
        backup = back_up(file)?;
        unfinished.write_all(text_of(rig, file).as_bytes())
    });
    written.with_context(|| format!("cannot write {}", file.display()))?;
    if let Some(backup) = backup {
        log::info!(
            "{} has all keys now, also those with default values; the previous file is {}",
            file.display(),
            backup.display()
        );
    }
    if let Ok(target) = linked {
        log::warn!(
            "{} was a symbolic link: it is a file now, and {} is unchanged",
            file.display(),
            target.display()
        );
    }
    Ok(())
}

/// Writes the robot's URDF next to a rig file, unless it is there, or the rig has none.
fn write_urdf(rig: &Rig, file: &Path) -> std::io::Result<()> {
    if !rig.arm.has_description() {
        return Ok(());
    }
    let urdf = file.with_file_name(drivers::recording::URDF_FILE);
    // The URDF is created but never replaced, because the folder may belong to another robot.
    let error = match files::create(&urdf, |out| out.write_all(rig.arm.urdf_text.as_bytes())) {
        Ok(()) => return Ok(()),
        Err(error) => error,
    };
    let problem = match error.kind() {
        ErrorKind::AlreadyExists if urdf.exists() => match other_robot(rig, file) {
            // Another program has written the URDF since it was checked.
            Some(_) => "it is that of another robot".to_owned(),
            None => return Ok(()),
        },
        _ => error.to_string(),
    };
    Err(std::io::Error::new(
        error.kind(),
        format!("{}: {problem}", urdf.display()),
    ))
}

/// Copies a file, if it exists, to an unused name, and returns this name.
fn back_up(file: &Path) -> std::io::Result<Option<PathBuf>> {
    if !file.exists() {
        return Ok(None);
    }
    let backup = unused_backup(file);
    let copy = |backup: &mut File| std::io::copy(&mut files::open(file)?, backup).map(drop);
    files::create(&backup, copy).map_err(|error| {
        std::io::Error::new(
            error.kind(),
            format!("cannot keep it as {}: {error}", backup.display()),
        )
    })?;
    Ok(Some(backup))
}

/// Path of a backup that does not exist yet.
fn unused_backup(file: &Path) -> PathBuf {
    let numbered = (2..).map(|number: u32| with_suffix(file, &format!(".old{number}")));
    let mut names = std::iter::once(with_suffix(file, ".old")).chain(numbered);
    // A broken symbolic link also occupies a name.
    names
        .find(|path| path.symlink_metadata().is_err())
        .expect("an unused number")
}

/// A path with text appended to its file name.
fn with_suffix(file: &Path, suffix: &str) -> PathBuf {
    let mut path = file.as_os_str().to_owned();
    path.push(suffix);
    PathBuf::from(path)
}

/// Applies a correction. `estimates` contain the standard deviation of the time offset, if it is
/// known. `source` names the method of estimation.
fn correct(
    camera: &mut Camera,
    correction: &CameraCorrection,
    estimates: &[Estimate],
    source: &str,
) {
    // A correction maps points from the frame of the reported camera to the frame of the true
    // camera. A rig file has the inverse direction.
    camera.parent_from_camera *=
        rigid_motion(correction.rotation_rad, correction.translation_m).inverse();
    if correction.time_offset_secs != 0.0 {
        let sigma = estimates.iter().find_map(|estimate| match estimate {
            Estimate::TimeOffset(time_offset) if *time_offset.camera == *camera.name => {
                Some(time_offset.sigma)
            }
            _ => None,
        });
        camera.stamp_to_mid_exposure = Some(TimeOffset {
            value_millis: camera
                .stamp_to_mid_exposure
                .as_ref()
                .map_or(0.0, |known| known.value_millis)
                + 1e3 * correction.time_offset_secs,
            sigma_millis: 1e3 * sigma.unwrap_or(0.0),
            source: source.to_owned(),
        });
    }
    if correction.readout_secs != 0.0 {
        let readout_micros = camera.readout_micros.unwrap_or(0.0) + 1e6 * correction.readout_secs;
        // Reading an image takes at most the time until the next one, and rig files reject other
        // values.
        camera.readout_micros = Some(readout_micros.clamp(0.0, 1e6 / camera.rate_hz));
    }
    if let Some(depth) = &mut camera.depth {
        // The lenses are compared before the lens of the color image is corrected. Depth that is
        // aligned with color has the same lens as the color image, also after the correction.
        let shares_lens = depth.intrinsics == camera.intrinsics.resized(depth.intrinsics.size_px)
            || depth.intrinsics == camera.intrinsics;
        if shares_lens {
            correct_lens(&mut depth.intrinsics, correction);
        }
        depth.camera_from_depth = rigid_motion(
            correction.depth_rotation_rad,
            correction.depth_translation_m,
        ) * depth.camera_from_depth;
        depth.factor *= correction.log_depth_scale.exp();
    }
    correct_lens(&mut camera.intrinsics, correction);
    // A covariance is valid only for the values with which it was estimated.
    if (correction.log_focal, correction.principal_offset_focals) != ([0.0; 2], [0.0; 2]) {
        camera.intrinsics_covariance.clear();
    }
}

/// A rigid motion from a rotation vector and a translation.
fn rigid_motion(rotation_rad: [f64; 3], translation_m: [f64; 3]) -> Transform {
    Transform::from_parts(
        Translation3::from(Vector3::from(translation_m)),
        UnitQuaternion::from_scaled_axis(Vector3::from(rotation_rad)),
    )
}

/// Corrects focal length and principal point.
fn correct_lens(intrinsics: &mut Intrinsics, correction: &CameraCorrection) {
    for axis in 0..2 {
        // The offset is in units of the focal length before its correction.
        intrinsics.principal_px[axis] +=
            correction.principal_offset_focals[axis] * intrinsics.focal_px[axis];
        intrinsics.focal_px[axis] *= correction.log_focal[axis].exp();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use calibration::ScalarEstimate;

    const TOLERANCE: f64 = 1e-12; // Rounding errors of products of poses with elements near 1.

    fn bundled_rig() -> Rig {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
        Rig::load(&file, &[]).unwrap()
    }

    #[test]
    fn every_correction_is_written_to_its_key() {
        let mut rig = bundled_rig();
        rig.arm.joints.reverse(); // The device orders joints differently from the chain.
        let correction = CameraCorrection {
            rotation_rad: [0.01, -0.02, 0.03],
            translation_m: [0.001, 0.002, -0.003],
            time_offset_secs: 0.004,
            log_focal: [0.01, 0.02],
            principal_offset_focals: [0.001, -0.002],
            joint_offsets: (0..7).map(f64::from).map(|joint| 0.001 * joint).collect(),
            depth_translation_m: [0.0, 0.0, 0.005],
            log_depth_scale: 0.01,
            readout_secs: -0.003,
            ..CameraCorrection::default()
        };
        let alignment = Alignment {
            corrections: BTreeMap::from([("wrist".to_owned(), correction.clone())]),
            estimates: vec![Estimate::TimeOffset(ScalarEstimate {
                camera: "wrist".to_owned(),
                value: 0.004,
                sigma: 1e-4,
            })],
            ..Alignment::default()
        };
        let calibrated_rig = corrected(&rig, Some(&alignment), &BTreeMap::new()).unwrap();
        let (before, after) = (&rig.cameras[0], &calibrated_rig.cameras[0]);
        // The correction is applied after camera_from_parent.
        let moved = Transform::new(
            Vector3::from(correction.translation_m),
            Vector3::from(correction.rotation_rad),
        );
        let expected = moved * before.parent_from_camera.inverse();
        let max_error = (after.parent_from_camera.inverse().to_homogeneous()
            - expected.to_homogeneous())
        .abs()
        .max();
        assert!(max_error < TOLERANCE, "{max_error}");
        let time_offset = after.stamp_to_mid_exposure.as_ref().unwrap();
        assert!(
            (time_offset.value_millis - 4.0).abs() < TOLERANCE
                && (time_offset.sigma_millis - 0.1).abs() < TOLERANCE
        );
        assert_eq!(time_offset.source, ALIGNED);
        assert!((after.readout_micros.unwrap() - 12_000.0).abs() < 1e-6);
        assert!(
            (after.intrinsics.focal_px[0] / before.intrinsics.focal_px[0] - 0.01f64.exp()).abs()
                < TOLERANCE
        );
        let [fx, fy] = before.intrinsics.focal_px;
        let moved = [0, 1]
            .map(|axis| after.intrinsics.principal_px[axis] - before.intrinsics.principal_px[axis]);
        assert!(
            (moved[0] - 0.001 * fx).abs() < 1e-9 && (moved[1] + 0.002 * fy).abs() < 1e-9,
            "{moved:?}"
        );
        let depth = after.depth.as_ref().unwrap();
        assert_eq!(
            depth.intrinsics.focal_px, after.intrinsics.focal_px,
            "depth uses the same lens"
        );
        assert!((depth.factor - 0.01f64.exp()).abs() < TOLERANCE);
        assert!(
            (depth.camera_from_depth.translation.vector - Vector3::new(0.0, 0.0, 0.005)).norm()
                < TOLERANCE
        );
        let expected: Vec<f64> = (0..7).rev().map(|joint| 0.001 * f64::from(joint)).collect();
        assert_eq!(calibrated_rig.arm.joint_offsets, expected);
        // The written file can be read back, and the URDF of another robot is not overwritten.
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("rig.toml");
        write(&calibrated_rig, &file).unwrap();
        assert_eq!(Rig::load(&file, &[]).unwrap(), calibrated_rig);
        assert!(
            Rig::load(&file, &[])
                .unwrap()
                .has_same_calibration(&calibrated_rig)
                && !rig.has_same_calibration(&calibrated_rig)
        );
        std::fs::write(
            folder.path().join(drivers::recording::URDF_FILE),
            "<robot/>",
        )
        .unwrap();
        assert!(
            write(&calibrated_rig, &file)
                .unwrap_err()
                .to_string()
                .contains("another robot")
        );
        assert!(check_target_file(&calibrated_rig, &folder.path().join("none/rig.toml")).is_err());
        assert!(
            check_target_file(&calibrated_rig, &file)
                .unwrap_err()
                .to_string()
                .contains("another robot"),
            "the check before training rejects it, too"
        );
    }

    #[test]
    fn rig_without_an_arm_neither_writes_nor_uses_a_robot_description() {
        const TEXT: &str = "[arm]\ndriver = \"none\"\n[camera.room]\ndriver = \"sim\"\nsize_px = [64, 48]\n\
                            rate_hz = 1\nparent = \"world\"\n";
        let rig = Rig::parse("rig.toml", TEXT, "", &[]).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("rig.toml");
        let urdf = folder.path().join(drivers::recording::URDF_FILE);
        write(&rig, &file).unwrap();
        assert!(!urdf.exists());
        // A rig with an arm can be written into the same folder afterwards, and beside its robot
        // description, rigs without an arm.
        write(&bundled_rig(), &file).unwrap();
        let robot = std::fs::read_to_string(&urdf).unwrap();
        write(&rig, &file).unwrap();
        assert_eq!(std::fs::read_to_string(&urdf).unwrap(), robot);
        assert_eq!(Rig::load(&file, &[]).unwrap(), rig);
    }

    /// This happens when several programs write their results into one rig file.
    #[test]
    fn no_result_of_simultaneous_writers_disappears() {
        const N_WRITERS: u32 = 4;
        const N_FILES: u32 = 10;
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("rig.toml");
        let write_often = |writer: u32| {
            let mut rig = bundled_rig();
            let mut texts = Vec::new();
            for ix in 0..N_FILES {
                rig.cameras[0].intrinsics.focal_px[0] = 600.0 + f64::from(N_FILES * writer + ix);
                match write(&rig, &file) {
                    Ok(()) => texts.push(text_of(&rig, &file)),
                    Err(error) => {
                        let message = format!("{error:#}");
                        assert!(
                            message.ends_with("rig.toml: another program is writing it"),
                            "{message}"
                        );
                    }
                }
            }
            texts
        };
        let mut written = std::thread::scope(|scope| {
            let write_often = &write_often;
            let writers: Vec<_> = (0..N_WRITERS)
                .map(|writer| scope.spawn(move || write_often(writer)))
                .collect();
            writers
                .into_iter()
                .flat_map(|writer| writer.join().unwrap())
                .collect::<Vec<String>>()
        });
        let is_rig = |path: &PathBuf| {
            path.file_name()
                .is_some_and(|name| name.to_string_lossy().starts_with("rig.toml"))
        };
        let paths = std::fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .filter(is_rig);
        let mut found: Vec<String> = paths
            .map(|path| std::fs::read_to_string(path).unwrap())
            .collect();
        written.sort();
        found.sort();
        assert!(
            !written.is_empty() && found == written,
            "{} files of {} writes",
            found.len(),
            written.len()
        );
        assert!(
            std::fs::read_dir(folder.path()).unwrap().count() == found.len() + 1,
            "these and the URDF"
        );
    }

    #[test]
    fn comments_of_the_rig_file_are_kept_except_for_guesses_that_were_measured() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let text = "# My robot.\n\n[arm]\ndriver = \"none\"\n[camera.room]\ndriver = \"sim\" # a webcam\n\
                    size_px = [64, 48]\nrate_hz = 1\nparent = \"world\"\n# Guess: in the corner.\n\
                    parent_from_camera = { xyz_m = [1, 0, 0] }\n# Guess: a usual lens.\n\
                    intrinsics = { focal_px = [60, 60], principal_px = [32, 24] }\n";
        std::fs::write(at("rig.toml"), text).unwrap();
        let rig = Rig::load(&at("rig.toml"), &[]).unwrap();
        let measured = Intrinsics {
            focal_px: [61.0, 61.5],
            ..rig.cameras[0].intrinsics.clone()
        };
        let rig = with_intrinsics(&rig, "room", &measured, None).unwrap();
        // The comments come from the rig file that was read, whichever file is written.
        for name in ["calibrated.toml", "rig.toml", "rig.toml"] {
            write(&rig, &at(name)).unwrap();
            let written = std::fs::read_to_string(at(name)).unwrap();
            for comment in [
                "# My robot.\n\n",
                "driver = \"sim\" # a webcam\n",
                "# Guess: in the corner.\n",
            ] {
                assert!(written.contains(comment), "{name}: {written}");
            }
            assert!(!written.contains("a usual lens"), "{name}: {written}");
            assert_eq!(Rig::load(&at(name), &[]).unwrap(), rig, "{name}");
            let guesses = capture::doctor::guesses(&written);
            assert!(
                guesses.len() == 1
                    && guesses[0]
                        .message
                        .starts_with("camera.room.parent_from_camera is a guess"),
                "{guesses:?}"
            );
        }
    }

    #[test]
    fn urdf_that_another_program_writes_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let (rig, file) = (bundled_rig(), folder.path().join("rig.toml"));
        let urdf = folder.path().join(drivers::recording::URDF_FILE);
        write_urdf(&rig, &file).unwrap();
        write_urdf(&rig, &file).expect("it is that of the same robot");
        std::fs::write(&urdf, "<robot/>").unwrap();
        let error = write_urdf(&rig, &file).unwrap_err().to_string();
        assert!(
            error.ends_with("robot.urdf: it is that of another robot"),
            "{error}"
        );
        assert_eq!(std::fs::read_to_string(&urdf).unwrap(), "<robot/>");
        std::fs::remove_file(&urdf).unwrap();
        std::os::unix::fs::symlink(folder.path().join("absent"), &urdf).unwrap();
        let error = write_urdf(&rig, &file).unwrap_err().to_string();
        assert!(error.ends_with("robot.urdf: it exists already"), "{error}");
    }

    #[test]
    fn intrinsics_and_extrinsics_are_replaced() {
        let rig = bundled_rig();
        let before = &rig.cameras[0];
        let other = Intrinsics {
            focal_px: [700.0, 701.0],
            ..before.intrinsics.clone()
        };
        let covariance = DMatrix::from_diagonal_element(4, 4, 0.25);
        let replaced = with_intrinsics(&rig, "wrist", &other, Some(&covariance)).unwrap();
        assert_eq!(replaced.cameras[0].intrinsics, other);
        assert_eq!(
            replaced.cameras[0].intrinsics_covariance,
            covariance.as_slice()
        );
        let again = with_intrinsics(&replaced, "wrist", &before.intrinsics, None).unwrap();
        assert!(
            again.cameras[0].intrinsics_covariance.is_empty(),
            "it was that of other intrinsics"
        );
        let depth = replaced.cameras[0].depth.as_ref().unwrap();
        assert_eq!(
            depth.intrinsics,
            other.resized(depth.intrinsics.size_px),
            "depth uses the same lens"
        );
        let pose = Transform::translation(0.1, 0.2, 0.3);
        let moved = with_extrinsics(&rig, "wrist", Parent::Flange, &pose).unwrap();
        assert_eq!(moved.cameras[0].parent_from_camera, pose);
        assert_eq!(moved.cameras[0].intrinsics, before.intrinsics);

        let message = |result: anyhow::Result<Rig>| result.unwrap_err().to_string();
        let unknown = message(with_intrinsics(&rig, "wirst", &other, None));
        assert!(
            unknown.contains("wirst") && unknown.contains("wrist"),
            "{unknown}"
        );
        let small = Intrinsics {
            size_px: [320, 240],
            ..other
        };
        assert!(message(with_intrinsics(&rig, "wrist", &small, None)).contains("320x240"));
        let base = message(with_extrinsics(&rig, "wrist", Parent::Base, &pose));
        assert!(
            base.contains("is flange") && base.contains("the base"),
            "{base}"
        );
    }

    #[test]
    fn pose_in_the_base_is_converted_for_a_camera_in_the_world() {
        let mut rig = bundled_rig();
        rig.cameras[0].parent = Parent::World;
        rig.base.world_from_base = Transform::new(Vector3::new(1.0, 2.0, 0.5), Vector3::z() * 0.5);
        let base_from_camera = Transform::new(Vector3::new(0.4, -0.1, 0.3), Vector3::x() * 1.5);
        let moved = with_extrinsics(&rig, "wrist", Parent::Base, &base_from_camera).unwrap();
        let difference = moved.cameras[0].parent_from_camera.inverse()
            * rig.base.world_from_base
            * base_from_camera;
        assert!(difference.translation.vector.norm() < 1e-12 && difference.rotation.angle() < 1e-7);
        rig.base.driver = capture::config::BaseDriver::Udp;
        let error = with_extrinsics(&rig, "wrist", Parent::Base, &base_from_camera)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("is world"),
            "a moving base has no fixed pose in the world: {error}"
        );
    }
}
