//! The rig file with what alignment found: the rig calibrates itself.

use crate::config::{Camera, Measured, Rig};
use crate::exit::BadArgument;
use anyhow::{Context, ensure};
use kinematics::{Chain, Intrinsics, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::path::Path;
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
pub(crate) fn refuse_place(file: &Path) -> Result<(), BadArgument> {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if folder.is_dir() && !file.is_dir() {
        return Ok(());
    }
    Err(BadArgument(format!("--write-rig {}: must be a file in a folder that exists", file.display())))
}

/// Writes a rig file, and the robot's description beside it, where no other one lies.
pub(crate) fn write(rig: &Rig, file: &Path) -> anyhow::Result<()> {
    let urdf = file.with_file_name(drivers::recording::URDF_FILE);
    let there = std::fs::read_to_string(&urdf).ok();
    ensure!(
        there.is_none_or(|text| text == rig.arm.urdf_text),
        "{} is another robot's description; the rig file wants a folder of its own",
        urdf.display()
    );
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
