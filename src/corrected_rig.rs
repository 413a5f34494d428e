//! The rig file with what alignment found: the rig calibrates itself.

use crate::config::{Camera, Measured, Rig};
use crate::exit::BadArgument;
use anyhow::Context;
use kinematics::{Chain, Intrinsics, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::path::{Path, PathBuf};
use trainer::align::{Alignment, Found};
use trainer::splat::CameraFix;

/// What a corrected delay says about where it comes from.
const SOURCE: &str = "train --write-rig";

/// The rig as it would have been right; poses of single images have no place in it.
pub(crate) fn corrected(rig: &Rig, alignment: &Alignment) -> anyhow::Result<Rig> {
    let mut rig = rig.clone();
    for camera in &mut rig.cameras {
        if let Some(fix) = alignment.fixes.get(&*camera.name) {
            correct(camera, fix, alignment);
        }
    }
    let longest = alignment.fixes.values().map(|fix| &fix.joint_offsets).max_by_key(|offsets| offsets.len());
    if let Some(by_chain) = longest.filter(|offsets| !offsets.is_empty()) {
        let chain = Chain::from_urdf(&rig.arm.urdf_text, &rig.arm.base_link, &rig.arm.flange_link)?;
        rig.arm.joint_offsets.resize(rig.arm.joints.len(), 0.0);
        for (place, offset) in chain.order_in(&rig.arm.joints)?.into_iter().zip(by_chain) {
            rig.arm.joint_offsets[place] += offset;
        }
    }
    Ok(rig)
}

/// Refuses a place where no file can be written.
pub(crate) fn refuse_place(rig: &Rig, file: &Path) -> Result<(), BadArgument> {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if !folder.is_dir() || file.is_dir() {
        return Err(BadArgument(format!("--write-rig {}: must be a file in a folder that exists", file.display())));
    }
    match other_robot(rig, file) {
        Some(urdf) => Err(BadArgument(format!(
            "--write-rig {}: {} is another robot's description; the rig file wants a folder of its own",
            file.display(),
            urdf.display()
        ))),
        None => Ok(()),
    }
}

/// The robot's description beside a rig file, where it is of another robot.
fn other_robot(rig: &Rig, file: &Path) -> Option<PathBuf> {
    let urdf = file.with_file_name(drivers::recording::URDF_FILE);
    let there = std::fs::read_to_string(&urdf).ok()?;
    (there != rig.arm.urdf_text).then_some(urdf)
}

/// Writes a rig file, and the robot's description beside it, where no other one lies.
pub(crate) fn write(rig: &Rig, file: &Path) -> anyhow::Result<()> {
    refuse_place(rig, file)?;
    let urdf = file.with_file_name(drivers::recording::URDF_FILE);
    let in_file = || format!("cannot write {}", file.display());
    std::fs::write(&urdf, &rig.arm.urdf_text).with_context(in_file)?;
    std::fs::write(file, rig.to_toml()).with_context(in_file)
}

fn correct(camera: &mut Camera, fix: &CameraFix, alignment: &Alignment) {
    let moved = |turn_rad: [f64; 3], shift_m: [f64; 3]| {
        Transform::from_parts(
            Translation3::from(Vector3::from(shift_m)),
            UnitQuaternion::from_scaled_axis(Vector3::from(turn_rad)),
        )
    };
    camera.parent_from_camera *= moved(fix.turn_rad, fix.shift_m).inverse();
    if fix.delay_secs != 0.0 {
        let sigma = alignment.found.iter().find_map(|found| match found {
            Found::Delay(delay) if *delay.camera == *camera.name => Some(delay.sigma),
            _ => None,
        });
        camera.stamp_to_mid_exposure = Some(Measured {
            value_millis: camera.stamp_to_mid_exposure.as_ref().map_or(0.0, |known| known.value_millis)
                + 1e3 * fix.delay_secs,
            sigma_millis: 1e3 * sigma.unwrap_or(0.0),
            source: SOURCE.to_owned(),
        });
    }
    if fix.readout_secs != 0.0 {
        let readout_micros = camera.readout_micros.unwrap_or(0.0) + 1e6 * fix.readout_secs;
        camera.readout_micros = Some(readout_micros.clamp(0.0, 1e6 / camera.rate_hz));
    }
    let correct_lens = |intrinsics: &mut Intrinsics| {
        for axis in 0..2 {
            intrinsics.principal_px[axis] += fix.principal_focals[axis] * intrinsics.focal_px[axis];
            intrinsics.focal_px[axis] *= fix.log_focal[axis].exp();
        }
    };
    if let Some(depth) = &mut camera.depth {
        let shares_lens = depth.intrinsics == camera.intrinsics.resized(depth.intrinsics.size_px)
            || depth.intrinsics == camera.intrinsics;
        if shares_lens {
            correct_lens(&mut depth.intrinsics);
        }
        depth.camera_from_depth = moved(fix.depth_turn_rad, fix.depth_shift_m) * depth.camera_from_depth;
        depth.factor *= fix.log_depth_scale.exp();
    }
    correct_lens(&mut camera.intrinsics);
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use trainer::align::Number;

    const CLOSE: f64 = 1e-12; // Rounding of products of poses near 1.

    fn shipped() -> Rig {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/static-arm.toml");
        Rig::load(&file, &[]).unwrap()
    }

    #[test]
    fn every_correction_finds_its_key() {
        let mut rig = shipped();
        rig.arm.joints.reverse(); // The device's order is not the chain's.
        let fix = CameraFix {
            turn_rad: [0.01, -0.02, 0.03],
            shift_m: [0.001, 0.002, -0.003],
            delay_secs: 0.004,
            log_focal: [0.01, 0.02],
            principal_focals: [0.001, -0.002],
            joint_offsets: (0..7).map(f64::from).map(|joint| 0.001 * joint).collect(),
            depth_shift_m: [0.0, 0.0, 0.005],
            log_depth_scale: 0.01,
            readout_secs: -0.003,
            ..CameraFix::default()
        };
        let alignment = Alignment {
            fixes: BTreeMap::from([("wrist".to_owned(), fix.clone())]),
            found: vec![Found::Delay(Number { camera: "wrist".to_owned(), value: 0.004, sigma: 1e-4 })],
            ..Alignment::default()
        };
        let found = corrected(&rig, &alignment).unwrap();
        let (before, after) = (&rig.cameras[0], &found.cameras[0]);
        // A turn and a shift after camera_from_parent.
        let moved = Transform::new(Vector3::from(fix.shift_m), Vector3::from(fix.turn_rad));
        let expected = moved * before.parent_from_camera.inverse();
        let off = (after.parent_from_camera.inverse().to_homogeneous() - expected.to_homogeneous()).abs().max();
        assert!(off < CLOSE, "{off}");
        let delay = after.stamp_to_mid_exposure.as_ref().unwrap();
        assert!((delay.value_millis - 4.0).abs() < CLOSE && (delay.sigma_millis - 0.1).abs() < CLOSE);
        assert_eq!(delay.source, SOURCE);
        assert!((after.readout_micros.unwrap() - 12_000.0).abs() < 1e-6);
        assert!((after.intrinsics.focal_px[0] / before.intrinsics.focal_px[0] - 0.01f64.exp()).abs() < CLOSE);
        let [fx, fy] = before.intrinsics.focal_px;
        let moved = [0, 1].map(|axis| after.intrinsics.principal_px[axis] - before.intrinsics.principal_px[axis]);
        assert!((moved[0] - 0.001 * fx).abs() < 1e-9 && (moved[1] + 0.002 * fy).abs() < 1e-9, "{moved:?}");
        let depth = after.depth.as_ref().unwrap();
        assert_eq!(depth.intrinsics.focal_px, after.intrinsics.focal_px, "depth comes through the same lens");
        assert!((depth.factor - 0.01f64.exp()).abs() < CLOSE);
        assert!((depth.camera_from_depth.translation.vector - Vector3::new(0.0, 0.0, 0.005)).norm() < CLOSE);
        let expected: Vec<f64> = (0..7).rev().map(|joint| 0.001 * f64::from(joint)).collect();
        assert_eq!(found.arm.joint_offsets, expected);
        // It is a rig file that can be read, and a second rig's description is not overwritten.
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("rig.toml");
        write(&found, &file).unwrap();
        assert_eq!(Rig::load(&file, &[]).unwrap(), found);
        assert!(Rig::load(&file, &[]).unwrap().sees_like(&found) && !rig.sees_like(&found));
        std::fs::write(folder.path().join(drivers::recording::URDF_FILE), "<robot/>").unwrap();
        assert!(write(&found, &file).unwrap_err().to_string().contains("another robot"));
        assert!(refuse_place(&found, &folder.path().join("none/rig.toml")).is_err());
        assert!(refuse_place(&found, &file).unwrap_err().to_string().contains("another robot"), "before training, too");
    }
}
