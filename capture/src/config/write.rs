//! Writes the effective rig file: every key of a checked rig, such that reading it gives the same rig.

use super::read::{
    ARM_DRIVERS, BASE_DRIVERS, CAMERA_DRIVERS, DELIVERIES, FILTERS, PACES, PARENTS, SCANNER_DRIVERS, STREAMS,
    TAG_FAMILIES,
};
use super::values::{is, name_of, table, whole};
use super::{
    Arm, Base, Camera, CameraSim, Depth, JoinConfig, Realsense, Rig, Scanner, Sim, Train, UnknownCalibration, V4l2,
};
use drivers::tags::TagPlacement;
use kinematics::{Intrinsics, Lens, Transform};
use toml::{Table, Value};

pub(super) fn rig(rig: &Rig) -> String {
    let cameras =
        rig.cameras.iter().map(|camera| (camera.name.to_string(), Value::Table(self::camera(camera)))).collect();
    let scanners =
        rig.scanners.iter().map(|scanner| (scanner.name.to_string(), Value::Table(self::scanner(scanner)))).collect();
    let file = table([
        ("arm", Some(Value::Table(arm(&rig.arm)))),
        ("base", Some(Value::Table(base(&rig.base)))),
        ("camera", Some(Value::Table(cameras))),
        ("range", Some(Value::Table(scanners))),
        ("join", Some(Value::Table(join(&rig.join)))),
        ("train", Some(Value::Table(train(&rig.train)))),
        ("sim", Some(Value::Table(sim(&rig.sim)))),
    ]);
    toml::to_string(&file).expect("tables of numbers and texts always serialize")
}

fn arm(arm: &Arm) -> Table {
    let [buses, motors] = super::can::write(&arm.buses, &arm.motors);
    table([
        ("driver", name_of(&ARM_DRIVERS, &arm.driver)),
        ("address", is(arm.address.as_str())),
        ("urdf", is(drivers::recording::URDF_FILE)),
        ("joints", is(arm.joints.clone())),
        ("joint_offsets", is(arm.joint_offsets.clone())),
        ("base_link", is(arm.base_link.as_str())),
        ("flange_link", is(arm.flange_link.as_str())),
        ("max_speed_rad_s", is(arm.max_speed_rad_s)),
        ("rate_hz", is(arm.rate_hz)),
        ("bus", buses),
        ("motor", motors),
        ("motion", arm.motion.as_ref().map(|motion| Value::Table(super::motion::write(motion)))),
    ])
}

fn base(base: &Base) -> Table {
    let tag = |tag: &TagPlacement| table([("size_m", is(tag.size_m)), ("world_from_tag", pose(&tag.world_from_tag))]);
    let tags: Table = base.tags.iter().map(|(id, placement)| (id.to_string(), Value::Table(tag(placement)))).collect();
    let sim = table([("drift_m", is(base.drift_m)), ("drift_rad", is(base.drift_rad))]);
    table([
        ("driver", name_of(&BASE_DRIVERS, &base.driver)),
        ("address", is(base.address.to_string())),
        ("world_from_base", pose(&base.world_from_base)),
        ("rate_hz", is(base.rate_hz)),
        ("realign", is(base.realign)),
        ("max_sigma_m", is(base.max_sigma_m)),
        ("max_sigma_rad", is(base.max_sigma_rad)),
        ("tag_family", name_of(&TAG_FAMILIES, &base.tag_family)),
        ("tag", (!tags.is_empty()).then_some(Value::Table(tags))),
        ("sim", Some(Value::Table(sim))),
    ])
}

fn scanner(scanner: &Scanner) -> Table {
    let sim = table([
        ("rings", whole(scanner.sim.rings.into())),
        ("columns", whole(scanner.sim.columns.into())),
        ("min_elevation_rad", is(scanner.sim.min_elevation_rad)),
        ("max_elevation_rad", is(scanner.sim.max_elevation_rad)),
        ("noise_sigma_m", is(scanner.sim.noise_sigma_m)),
        ("dropped_frac", is(scanner.sim.dropped_frac)),
    ]);
    table([
        ("driver", name_of(&SCANNER_DRIVERS, &scanner.driver)),
        ("address", is(scanner.address.to_string())),
        ("rate_hz", is(scanner.rate_hz)),
        ("base_from_scanner", pose(&scanner.base_from_scanner)),
        ("min_m", is(scanner.min_m)),
        ("max_m", is(scanner.max_m)),
        ("sim", Some(Value::Table(sim))),
    ])
}

fn camera(camera: &Camera) -> Table {
    let time_offset = camera.stamp_to_mid_exposure.as_ref().map(|time_offset| {
        Value::Table(table([
            ("value", is(time_offset.value_millis)),
            ("sigma", is(time_offset.sigma_millis)),
            ("source", is(time_offset.source.as_str())),
        ]))
    });
    let unknown = camera.realsense.unknown;
    table([
        ("driver", name_of(&CAMERA_DRIVERS, &camera.driver)),
        ("device", is(camera.device.as_str())),
        ("size_px", size_px(camera.intrinsics.size_px)),
        ("rate_hz", is(camera.rate_hz)),
        ("exposure_micros", camera.exposure_micros.map(Value::from)),
        ("readout_micros", camera.readout_micros.map(Value::from)),
        ("stamp_to_mid_exposure_millis", time_offset),
        ("parent", name_of(&PARENTS, &camera.parent)),
        ("parent_from_camera", pose(&camera.parent_from_camera)),
        ("intrinsics", intrinsics(&camera.intrinsics).filter(|_| !unknown.intrinsics)),
        ("rectified", is(camera.intrinsics.rectified && !unknown.intrinsics)),
        ("v4l2", Some(Value::Table(v4l2(&camera.v4l2)))),
        ("realsense", Some(Value::Table(realsense(&camera.realsense)))),
        ("depth", camera.depth.as_ref().map(|depth| Value::Table(self::depth(depth, unknown)))),
        ("sim", Some(Value::Table(camera_sim(&camera.sim)))),
    ])
}

fn v4l2(v4l2: &V4l2) -> Table {
    table([
        ("format", v4l2.format.map(|format| Value::from(format.name()))),
        ("gain", v4l2.gain.map(Value::from)),
        ("brightness", v4l2.brightness.map(Value::from)),
        ("white_balance_kelvin", v4l2.white_balance_kelvin.map(Value::from)),
        ("delivery", name_of(&DELIVERIES, &v4l2.delivery)),
        ("reconnect_secs", is(v4l2.reconnect_secs)),
    ])
}

fn realsense(realsense: &Realsense) -> Table {
    let filters: Vec<Value> = realsense.filters.iter().filter_map(|filter| name_of(&FILTERS, filter)).collect();
    table([
        ("file", is(realsense.file.to_string_lossy().into_owned())),
        ("pace", name_of(&PACES, &realsense.pace)),
        ("clock_offset_nanos", is(realsense.clock_offset_nanos)),
        ("stream", name_of(&STREAMS, &realsense.stream)),
        ("gain", realsense.gain.map(Value::from)),
        ("brightness", realsense.brightness.map(Value::from)),
        ("white_balance_kelvin", realsense.white_balance_kelvin.map(Value::from)),
        ("preset", realsense.preset.as_deref().map(Value::from)),
        ("laser_power", realsense.laser_power.map(Value::from)),
        ("filters", is(filters)),
        ("reconnect_secs", is(realsense.reconnect_secs)),
    ])
}

/// Calibration that only the camera reports is omitted.
fn depth(depth: &Depth, unknown: UnknownCalibration) -> Table {
    table([
        ("device", is(depth.device.as_str())),
        ("meters_per_count", depth.meters_per_count.map(Value::from)),
        ("size_px", size_px(depth.intrinsics.size_px)),
        ("intrinsics", intrinsics(&depth.intrinsics).filter(|_| !unknown.depth_intrinsics)),
        ("rectified", is(depth.intrinsics.rectified)),
        ("camera_from_depth", pose(&depth.camera_from_depth).filter(|_| !unknown.camera_from_depth)),
        ("factor", is(depth.factor)),
        ("min_m", is(depth.min_m)),
        ("max_m", is(depth.max_m)),
    ])
}

fn camera_sim(sim: &CameraSim) -> Table {
    table([
        ("noise_sigma", is(sim.noise_sigma)),
        ("shot_frac", is(sim.shot_frac)),
        ("blur_samples", whole(sim.blur_samples.into())),
        ("latency_millis", is(sim.latency_millis)),
        ("dropped_frac", is(sim.dropped_frac)),
        ("supersample", whole(sim.supersample.into())),
        ("depth_noise_sigma_m", is(sim.depth_noise_sigma_m)),
        ("depth_hole_frac", is(sim.depth_hole_frac)),
        ("meters_per_count", is(sim.meters_per_count)),
    ])
}

fn join(join: &JoinConfig) -> Table {
    table([
        ("start_keyframes", whole(join.start_keyframes as u64)),
        ("max_keyframes", whole(join.max_keyframes as u64)),
        ("max_bytes", whole(join.max_bytes)),
        ("min_translation_m", is(join.min_translation_m)),
        ("min_rotation_rad", is(join.min_rotation_rad)),
        ("fixed_interval_millis", is(join.fixed_interval_millis)),
        ("fixed_keyframes", whole(join.fixed_keyframes as u64)),
        ("min_sharpness_frac", is(join.min_sharpness_frac)),
        ("max_blur_px", is(join.max_blur_px)),
        ("max_shear_px", is(join.max_shear_px)),
        ("min_luma_frac", is(join.min_luma_frac)),
        ("max_luma_frac", is(join.max_luma_frac)),
        ("max_clipped_frac", is(join.max_clipped_frac)),
        ("default_depth_m", is(join.default_depth_m)),
        ("max_gap_millis", is(join.max_gap_millis)),
        ("max_wait_millis", is(join.max_wait_millis)),
        ("max_range_scans", whole(join.max_range_scans as u64)),
    ])
}

fn train(train: &Train) -> Table {
    table([
        ("method", is(methods(train.methods.names()))),
        ("max_splats", train.max_splats.and_then(whole)),
        ("max_bytes", train.max_bytes.and_then(whole)),
        ("seed", whole(train.seed)),
        ("sh_degree", whole(train.sh_degree.into())),
        ("scale", is(train.scale)),
    ])
}

/// The value of `train.method`: a word, or a list of words if there are several.
fn methods(names: &[String]) -> Value {
    match names {
        [one] => one.as_str().into(),
        several => several.to_vec().into(),
    }
}

fn sim(sim: &Sim) -> Table {
    table([
        ("scene", is(sim.scene.as_str())),
        ("seed", whole(sim.seed)),
        ("ideal", is(sim.ideal)),
        ("lockstep", is(sim.lockstep)),
        ("speed", is(sim.speed)),
        ("azimuth_only", is(sim.azimuth_only)),
        ("duration_secs", sim.duration_secs.map(Value::from)),
        ("n_images", sim.n_images.and_then(whole)),
        ("truth", is(sim.truth)),
        ("truth_depth", is(sim.truth_depth)),
        ("light_inside_frac", is(sim.light_inside_frac)),
    ])
}

fn size_px([width, height]: [u32; 2]) -> Option<Value> {
    is(vec![i64::from(width), i64::from(height)])
}

fn pose(pose: &Transform) -> Option<Value> {
    let quaternion = pose.rotation.quaternion();
    Some(Value::Table(table([
        ("xyz_m", is(pose.translation.vector.iter().copied().collect::<Vec<_>>())),
        ("quat_xyzw", is(vec![quaternion.i, quaternion.j, quaternion.k, quaternion.w])),
    ])))
}

fn intrinsics(intrinsics: &Intrinsics) -> Option<Value> {
    let (lens, distortion): (&str, &[f64]) = match &intrinsics.lens {
        Lens::Pinhole => ("pinhole", &[]),
        Lens::BrownConrady(k) => ("brown_conrady", k),
        Lens::KannalaBrandt(k) => ("kannala_brandt", k),
    };
    Some(Value::Table(table([
        ("focal_px", is(intrinsics.focal_px.to_vec())),
        ("principal_px", is(intrinsics.principal_px.to_vec())),
        ("lens", is(lens)),
        ("distortion", is(distortion.to_vec())),
    ])))
}
