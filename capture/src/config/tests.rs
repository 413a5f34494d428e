//! Tests that every key of the rig file is documented, has an effect and is checked, and that
//! effective rig files give the same rig.

use super::{ConfigError, Override, Rig, rig_file};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use toml::Value;

pub(super) const URDF: &str = r#"<robot name="two"><link name="a"/><link name="b"/><link name="c"/><link name="tool"/>
<joint name="j1" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="j2" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="fix" type="fixed"><parent link="c"/><child link="tool"/></joint></robot>"#;

/// A rig file with every table, so that each key can be changed separately.
pub(super) const RIG: &str = r#"
[arm]
driver = "sim"
urdf = "two.urdf"
flange_link = "c"
[camera.wrist]
driver = "v4l2"
size_px = [640, 480]
rate_hz = 30
parent = "flange"
parent_from_camera = { xyz_m = [0.0, 0.0, 0.1], quat_xyzw = [0.0, 0.0, 0.0, 1.0] }
stamp_to_mid_exposure_millis = { value = -1.0, sigma = 0.5, source = "by hand" }
intrinsics = { focal_px = [600, 600], principal_px = [320.0, 240.0], lens = "brown_conrady", distortion = [0, 0, 0, 0, 0] }
[camera.wrist.depth]
size_px = [320, 240]
intrinsics = { focal_px = [300, 300], principal_px = [160.0, 120.0], lens = "brown_conrady", distortion = [0, 0, 0, 0, 0] }
[camera.wrist.sim]
[base]
[join]
[train]
[sim]
[range.lidar]
driver = "udp"
[range.lidar.sim]
[camera.wrist.v4l2]
[arm.bus.can0]
[arm.bus.can1]
[arm.motor.first]
family = "damiao"
bus = "can0"
id = 1
feedback_id = 17
stiffness_nm_rad = 30
damping_nm_s_rad = 1
[arm.motor.second]
family = "robstride"
bus = "can0"
id = 2
model = "rs02"
[arm.motor.third]
family = "cia402"
bus = "can0"
id = 3
counts_per_turn = 65536
[arm.serial]
[arm.servo.first]
id = 1
[arm.motion]
on_loss = "release"
[base.motion]
[base.tag.7]
size_m = 0.1
[camera.wrist.sim.truth]
parent_from_camera = { xyz_m = [0.0, 0.0, 0.1], quat_xyzw = [0.0, 0.0, 0.0, 1.0] }
intrinsics = { focal_px = [600, 600], principal_px = [320.0, 240.0], lens = "brown_conrady", distortion = [0, 0, 0, 0, 0] }
camera_from_depth = { xyz_m = [0.0, 0.0, 0.1], quat_xyzw = [0.0, 0.0, 0.0, 1.0] }
[arm.sim]
[sim.target.board]
spec = "charuco:5x7:34mm:26mm:5X5_100"
world_from_board = { xyz_m = [0.0, 0.0, 0.0], quat_xyzw = [0.0, 0.0, 0.0, 1.0] }
flange_from_board = { xyz_m = [0.0, 0.0, 0.1], quat_xyzw = [0.0, 0.0, 0.0, 1.0] }
"#;

fn parse(text: &str, overrides: &[Override]) -> Result<Rig, ConfigError> {
    Rig::parse("rig.toml", text, URDF, overrides)
}

fn with(key: &'static str, value: &str) -> Result<Rig, ConfigError> {
    let value: toml::Table = toml::from_str(&format!("value = {value}")).expect("a TOML value");
    parse(RIG, &[Override::new(key, value["value"].clone())])
}

/// Key, a valid value that differs from the current one, and an invalid value.
pub(super) const KEYS: &[(&str, &str, &str)] = &[
    ("arm.rate_hz", "500", "0"),
    ("arm.bus.can0.bitrate_hz", "500_000", "1"),
    ("arm.bus.can0.data_bitrate_hz", "5_000_000", "9_000_000"),
    ("arm.bus.can0.accept_no_restart", "true", "1"),
    (
        "arm.motor.first",
        "{ family = 'odrive', bus = 'can0', id = 1 }",
        "{ family = 'odrive', bus = 'can0', id = 63 }",
    ),
    (
        "arm.motor.first",
        "{ family = 'tmotor', bus = 'can0', id = 1, model = 'ak80-64' }",
        "{ bus = 'can0', id = 1 }",
    ),
    ("arm.motor.first.family", "'damiao'", "'dynamixel'"),
    ("arm.motor.first.bus", "'can1'", "'can2'"),
    ("arm.motor.first.id", "9", "2047"),
    ("arm.motor.first.feedback_id", "18", "-1"),
    ("arm.motor.second.model", "'rs03'", "'ak80-9'"),
    ("arm.motor.third.counts_per_turn", "4096", "0"),
    ("arm.motor.third.rated_torque_nm", "12.5", "-1"),
    ("arm.motor.third.gear_ratio", "50", "0"),
    ("arm.motor.third.reversed", "true", "-1"),
    ("arm.motor.third.offset_rad", "-0.5", "'left'"),
    ("arm.motor.first.stiffness_nm_rad", "60.5", "-1"),
    ("arm.motor.first.damping_nm_s_rad", "0", "'much'"),
    ("arm.motor.first.max_following_error_rad", "0.05", "0"),
    ("arm.motor.first.max_effort_nm", "12.5", "-1"),
    ("arm.motor.first.accept_following_errors", "true", "1"),
    ("arm.motion.on_loss", "'hold'", "'panic'"),
    ("arm.motion.timeout_millis", "50", "0"),
    ("arm.motion.acceleration_secs", "1", "0"),
    ("arm.motion.jerk_secs", "0.2", "0"),
    ("arm.motion.accept_no_watchdog", "true", "1"),
    (
        "arm.motion.contact_torque_nm",
        "[9, 9, 9, 9, 9, 9, 9]",
        "[20, 20]",
    ),
    ("arm.motion.contact_force_n", "[10, 10, 10]", "[0, 0, 0]"),
    ("arm.motion.contact_moment_nm", "[10, 10, 10.5]", "20"),
    (
        "arm.motion.stiffness_nm_rad",
        "[3000, 3000, 3000, 2500, 2500, 2000, 2000]",
        "[1, 1, 1, 1, 1, 1, 1]",
    ),
    ("arm.motion.odrive_endpoints", "'flat_endpoints.json'", "7"),
    ("arm.motion.steering.max_speed_m_s", "0.1", "2"),
    ("arm.motion.steering.max_angular_rad_s", "0.5", "0"),
    (
        "arm.motion.steering.workspace_m",
        "[-1, -1, 0, 1, 1, 1]",
        "[0, 1]",
    ),
    ("arm.motion.steering.servo_round_trip_millis", "50", "0"),
    ("arm.motion.steering.swept_margin_m", "0.05", "0.5"),
    ("arm.serial.device", "'/dev/ttyACM0'", "7"),
    ("arm.serial.baud_hz", "57_600", "1"),
    ("arm.serial.reconnect_secs", "5", "-1"),
    ("arm.serial.calibration", "'so101.json'", "7"),
    ("arm.servo.first.id", "3", "253"),
    ("arm.servo.first.zero_counts", "1024", "1.5"),
    ("arm.servo.first.reversed", "true", "-1"),
    ("arm.servo.first.gear_ratio", "2.5", "0"),
    ("arm.servo.first.max_following_error_rad", "0.05", "0"),
    ("arm.servo.first.accept_following_errors", "true", "1"),
    ("arm.driver", "'franka'", "'frankka'"),
    ("arm.driver", "'none'", "'nothing'"),
    ("arm.driver", "'ur'", "'ur5e'"),
    ("arm.address", "'172.16.0.2'", "7"),
    ("arm.urdf", "'other.urdf'", "7"),
    ("arm.mesh_folder", "'/opt/meshes'", "7"),
    ("arm.joints", "['j2', 'j1']", "['j1', 'j9']"),
    ("arm.joint_offsets", "[0.01, -0.02]", "[0.01]"),
    ("arm.sim.true_joint_offsets", "[0.01, -0.02]", "[0.01]"),
    ("arm.base_link", "'b'", "'nowhere'"),
    ("arm.flange_link", "'tool'", "'nowhere'"),
    ("arm.max_speed_rad_s", "0.25", "-1"),
    ("base.driver", "'tags'", "'floating'"),
    ("base.address", "'0.0.0.0:7009'", "'localhost'"),
    ("base.world_from_base.xyz_m", "[1, 0, 0]", "[1, 0]"),
    (
        "base.world_from_base.quat_xyzw",
        "[1, 0, 0, 0]",
        "[1, 1, 0, 0]",
    ),
    ("base.rate_hz", "50", "0"),
    ("base.realign", "false", "1"),
    ("base.max_sigma_m", "0.01", "0"),
    ("base.max_sigma_rad", "0.01", "7"),
    ("base.tag_family", "'tag25h9'", "'tag37h11'"),
    ("base.tag.7.size_m", "0.2", "0"),
    ("base.tag.7.world_from_tag.xyz_m", "[1, 0, 0]", "[1, 0]"),
    (
        "base.tag.7.world_from_tag.quat_xyzw",
        "[0, 1, 0, 0]",
        "[0, 0, 0, 0]",
    ),
    ("base.motion.address", "'127.0.0.1:7020'", "'localhost'"),
    ("base.motion.max_forward_m_s", "0.5", "0"),
    ("base.motion.max_sideways_m_s", "0.2", "-1"),
    ("base.motion.max_yaw_rad_s", "1", "0"),
    ("base.motion.acceleration_m_s2", "0.2", "0"),
    ("base.motion.yaw_acceleration_rad_s2", "0.5", "0"),
    ("base.motion.brake_m_s2", "1", "100"),
    ("base.motion.brake_yaw_rad_s2", "2", "0"),
    ("base.motion.area_m", "[-1, -1, 1, 1]", "[-1, 1]"),
    ("base.motion.stowed", "[0, -1.5]", "'folded'"),
    ("base.motion.stowed_tolerance", "0.05", "0"),
    ("base.motion.footprint_radius_m", "0.4", "0"),
    (
        "base.motion.footprint_m",
        "[-0.3, -0.2, 0.3, -0.2, 0.3, 0.2, -0.3, 0.2]",
        "'square'",
    ),
    ("base.motion.footprint_height_m", "[-0.3, 0.4]", "[0.1]"),
    ("base.motion.allow_unseen", "true", "'yes'"),
    ("base.motion.swept_margin_m", "0.1", "0.5"),
    ("base.sim.drift_m", "0.1", "-0.1"),
    ("base.sim.drift_rad", "0.05", "2"),
    ("range.lidar.driver", "'sim'", "'laser'"),
    ("range.lidar.address", "'[::1]:0'", "7010"),
    ("range.lidar.rate_hz", "5", "0"),
    (
        "range.lidar.base_from_scanner.xyz_m",
        "[0, 0, 0.2]",
        "[0, 0]",
    ),
    (
        "range.lidar.base_from_scanner.quat_xyzw",
        "[0, 1, 0, 0]",
        "[0, 0, 0, 0]",
    ),
    ("range.lidar.min_m", "0.2", "-0.2"),
    ("range.lidar.max_m", "30", "0.1"),
    ("range.lidar.sim.rings", "32", "0"),
    ("range.lidar.sim.columns", "360", "3"),
    ("range.lidar.sim.min_elevation_rad", "-0.4", "-2"),
    ("range.lidar.sim.max_elevation_rad", "0.4", "2"),
    ("range.lidar.sim.noise_sigma_m", "0.01", "-1"),
    ("range.lidar.sim.dropped_frac", "0.1", "1"),
    ("camera.wrist.driver", "'realsense'", "'webcam'"),
    ("camera.wrist.device", "'/dev/video7'", "7"),
    ("camera.wrist.size_px", "[800, 600]", "[640, 480.5]"),
    ("camera.wrist.rate_hz", "15", "0"),
    ("camera.wrist.exposure_micros", "4000", "40_000"),
    ("camera.wrist.readout_micros", "15000", "-1"),
    ("camera.wrist.mask_robot", "true", "1"),
    ("camera.wrist.mask_margin_m", "0.03", "-0.01"),
    (
        "camera.wrist.stamp_to_mid_exposure_millis.value",
        "-12.4",
        "'late'",
    ),
    (
        "camera.wrist.stamp_to_mid_exposure_millis.sigma",
        "0.6",
        "-0.6",
    ),
    (
        "camera.wrist.stamp_to_mid_exposure_millis.source",
        "'calibrate'",
        "1",
    ),
    ("camera.wrist.parent", "'base'", "'tool'"),
    (
        "camera.wrist.parent_from_camera.xyz_m",
        "[0, 0, 0.2]",
        "[0, 0, inf]",
    ),
    (
        "camera.wrist.parent_from_camera.quat_xyzw",
        "[0, 1, 0, 0]",
        "[0, 0, 0, 0]",
    ),
    ("camera.wrist.intrinsics_covariance", "[1, 0]", "1"),
    ("camera.wrist.intrinsics.focal_px", "[500, 501]", "[0, 500]"),
    (
        "camera.wrist.intrinsics.principal_px",
        "[321, 241]",
        "[nan, 240]",
    ),
    ("camera.wrist.intrinsics.lens", "'pinhole'", "'fisheye'"),
    (
        "camera.wrist.intrinsics.distortion",
        "[0, 0, 0, 0, 0.1]",
        "[0.1]",
    ),
    ("camera.wrist.rectified", "true", "1"),
    ("camera.wrist.realsense.file", "'/tmp/walk.bag'", "7"),
    ("camera.wrist.realsense.pace", "'fast'", "'slow'"),
    (
        "camera.wrist.realsense.clock_offset_nanos",
        "-1_234_567",
        "0.5",
    ),
    ("camera.wrist.realsense.stream", "'infrared'", "'depth'"),
    ("camera.wrist.realsense.gain", "16", "1.5"),
    ("camera.wrist.realsense.brightness", "-12", "'bright'"),
    ("camera.wrist.realsense.white_balance_kelvin", "4600", "46"),
    ("camera.wrist.realsense.preset", "'high accuracy'", "3"),
    ("camera.wrist.realsense.laser_power", "150", "-1"),
    (
        "camera.wrist.realsense.filters",
        "['spatial', 'temporal']",
        "['sharpen']",
    ),
    ("camera.wrist.realsense.reconnect_secs", "5", "-1"),
    ("camera.wrist.v4l2.format", "'mjpeg'", "'h264'"),
    ("camera.wrist.v4l2.gain", "12", "1.5"),
    ("camera.wrist.v4l2.brightness", "-12", "'bright'"),
    ("camera.wrist.v4l2.white_balance_kelvin", "4600", "46"),
    ("camera.wrist.v4l2.delivery", "'newest'", "'some'"),
    ("camera.wrist.v4l2.reconnect_secs", "5", "-1"),
    ("camera.wrist.depth.device", "'/dev/video9'", "9"),
    ("camera.wrist.depth.meters_per_count", "0.001", "0"),
    ("camera.wrist.depth.size_px", "[640, 480]", "[4, 4]"),
    (
        "camera.wrist.depth.intrinsics.focal_px",
        "[301, 300]",
        "[300]",
    ),
    (
        "camera.wrist.depth.intrinsics.principal_px",
        "[161, 120]",
        "160",
    ),
    ("camera.wrist.depth.intrinsics.lens", "'pinhole'", "'thin'"),
    (
        "camera.wrist.depth.intrinsics.distortion",
        "[0, 0, 0, 0, 0.1]",
        "[0, 0]",
    ),
    ("camera.wrist.depth.rectified", "true", "'yes'"),
    (
        "camera.wrist.depth.camera_from_depth.xyz_m",
        "[0.01, 0, 0]",
        "[]",
    ),
    (
        "camera.wrist.depth.camera_from_depth.quat_xyzw",
        "[0, 1, 0, 0]",
        "[2, 0, 0, 0]",
    ),
    ("camera.wrist.depth.factor", "1.01", "0"),
    ("camera.wrist.depth.min_m", "0.2", "-0.2"),
    ("camera.wrist.depth.max_m", "3", "0.05"),
    ("camera.wrist.sim.noise_sigma", "1", "-1"),
    ("camera.wrist.sim.shot_frac", "0.5", "1.5"),
    ("camera.wrist.sim.blur_samples", "4", "0"),
    ("camera.wrist.sim.latency_millis", "30", "-1"),
    ("camera.wrist.sim.dropped_frac", "0.1", "1"),
    ("camera.wrist.sim.supersample", "2", "2.5"),
    ("camera.wrist.sim.depth_noise_sigma_m", "0.01", "2"),
    ("camera.wrist.sim.depth_hole_frac", "0.1", "1"),
    ("camera.wrist.sim.meters_per_count", "0.001", "0"),
    (
        "camera.wrist.sim.truth.parent_from_camera.xyz_m",
        "[0, 0, 0.2]",
        "[0, 0, inf]",
    ),
    (
        "camera.wrist.sim.truth.parent_from_camera.quat_xyzw",
        "[0, 1, 0, 0]",
        "[0, 0, 0, 0]",
    ),
    (
        "camera.wrist.sim.truth.intrinsics.focal_px",
        "[500, 501]",
        "[0, 500]",
    ),
    (
        "camera.wrist.sim.truth.intrinsics.principal_px",
        "[321, 241]",
        "[nan, 240]",
    ),
    (
        "camera.wrist.sim.truth.intrinsics.lens",
        "'pinhole'",
        "'thin'",
    ),
    (
        "camera.wrist.sim.truth.intrinsics.distortion",
        "[0, 0, 0, 0, 0.1]",
        "[0.1]",
    ),
    (
        "camera.wrist.sim.truth.stamp_to_mid_exposure_millis",
        "-12",
        "2000",
    ),
    ("camera.wrist.sim.truth.clock_drift_ppm", "75", "'fast'"),
    ("camera.wrist.sim.truth.readout_micros", "12_000", "-1"),
    (
        "camera.wrist.sim.truth.camera_from_depth.xyz_m",
        "[0.01, 0, 0]",
        "[]",
    ),
    (
        "camera.wrist.sim.truth.camera_from_depth.quat_xyzw",
        "[0, 1, 0, 0]",
        "[2, 0, 0, 0]",
    ),
    ("camera.wrist.sim.truth.depth_factor", "1.01", "0"),
    ("join.start_keyframes", "8", "0"),
    ("join.max_keyframes", "50", "7"),
    ("join.max_bytes", "50_000_000", "-5"),
    ("join.min_translation_m", "0.05", "0"),
    ("join.min_rotation_rad", "0.1", "4"),
    ("join.fixed_interval_millis", "500", "-1"),
    ("join.fixed_keyframes", "8", "0"),
    ("join.min_sharpness_frac", "0.2", "1.2"),
    ("join.max_blur_px", "3", "-3"),
    ("join.max_shear_px", "10", "'ten'"),
    ("join.min_luma_frac", "0.1", "-0.1"),
    ("join.max_luma_frac", "0.9", "1.1"),
    ("join.max_clipped_frac", "0.2", "2"),
    ("join.default_depth_m", "2", "0"),
    ("join.max_gap_millis", "20", "0"),
    ("join.max_wait_millis", "100", "0"),
    ("join.max_range_scans", "50", "-1"),
    ("train.method", "'tsdf'", "7"),
    ("train.method", "['tsdf', 'splat']", "['tsdf', 'tsdf']"),
    ("train.method", "['splat', 'nerf']", "['splat', 7]"),
    ("train.method", "['nerf']", "[]"),
    ("train.max_splats", "1_500_000", "0"),
    ("train.max_bytes", "100_000_000", "1"),
    ("train.seed", "7", "-7"),
    ("train.sh_degree", "2", "4"),
    ("train.scale", "0.5", "0"),
    ("sim.scene", "'mobile-arm'", "1"),
    ("sim.seed", "3", "0.5"),
    ("sim.ideal", "true", "'yes'"),
    ("sim.lockstep", "true", "1"),
    ("sim.speed", "0.5", "3"),
    ("sim.azimuth_only", "true", "1"),
    ("sim.emulate_arm", "true", "1"),
    ("sim.duration_secs", "60", "0"),
    ("sim.n_images", "300", "0"),
    ("sim.truth", "false", "0"),
    ("sim.truth_depth", "true", "0"),
    ("sim.light_inside_frac", "0.5", "-1"),
    ("sim.target.board.spec", "'tag:36h11:5:100mm'", "5"),
    (
        "sim.target.board.world_from_board.xyz_m",
        "[1, 2, 3]",
        "[1, 2]",
    ),
    (
        "sim.target.board.world_from_board.quat_xyzw",
        "[0, 1, 0, 0]",
        "[0, 0, 0, 0]",
    ),
    (
        "sim.target.board.flange_from_board.xyz_m",
        "[1, 2, 3]",
        "[1, 2]",
    ),
    (
        "sim.target.board.flange_from_board.quat_xyzw",
        "[0, 1, 0, 0]",
        "[0, 0, 0, 0]",
    ),
    ("sim.target.board.moved_before", "'wrist'", "5"),
    // These are the same settings as whole tables, because a flag may also replace a table.
    ("base.world_from_base", "{ xyz_m = [1, 2, 3] }", "3"),
    (
        "range.lidar.base_from_scanner",
        "{ xyz_m = [1, 2, 3] }",
        "3",
    ),
    (
        "camera.wrist.stamp_to_mid_exposure_millis",
        "{ value = 2 }",
        "2",
    ),
    (
        "camera.wrist.parent_from_camera",
        "{ xyz_m = [1, 2, 3] }",
        "[1, 2, 3]",
    ),
    ("camera.wrist.depth", "{ min_m = 0.3 }", "true"),
    (
        "camera.wrist.intrinsics",
        "{ focal_px = [500, 500], principal_px = [1, 1] }",
        "'narrow'",
    ),
];

#[test]
fn every_key_takes_effect_and_rejects_invalid_values() {
    let rig = parse(RIG, &[]).expect("a good rig file");
    let mut invalid = Vec::new();
    for &(key, good, bad) in KEYS {
        match with(key, good) {
            // The path of the robot description is not part of the rig, and other motor families
            // need other keys.
            Ok(changed)
                if changed == rig && !["arm.urdf", "arm.motor.first.family"].contains(&key) =>
            {
                invalid.push(format!("{key} = {good} changes nothing"))
            }
            Ok(_) => {}
            Err(e) => invalid.push(format!("{key} = {good} is rejected: {e}")),
        }
        match with(key, bad) {
            Ok(_) => invalid.push(format!("{key} = {bad} is accepted")),
            Err(e) if !names(&e.to_string(), key) => {
                invalid.push(format!("{key} = {bad}: the message does not name it: {e}"))
            }
            Err(_) => {}
        }
    }
    assert!(invalid.is_empty(), "{}", invalid.join("\n"));
}

/// Whether a message names the key; an invalid base link is reported with the key of the flange
/// link.
fn names(message: &str, key: &str) -> bool {
    message.contains(key)
        || (key == "arm.base_link"
            && message.contains("arm.flange_link")
            && message.contains("nowhere"))
}

#[test]
fn resolved_file_gives_the_same_rig() {
    for &(key, good, _) in KEYS {
        let rig = with(key, good).expect("a good value");
        let again =
            parse(&rig.to_toml(), &[]).unwrap_or_else(|e| panic!("{key}: {e}\n{}", rig.to_toml()));
        assert_eq!(again, rig, "{key}");
        assert_eq!(again.to_toml(), rig.to_toml(), "{key}");
    }
}

#[test]
fn documentation_lists_exactly_the_existing_keys() {
    let page = include_str!("../../../docs/reference/rig.md");
    let documented: BTreeMap<String, &str> = page
        .lines()
        .filter_map(|line| {
            Some((
                line.strip_prefix("| `")?.split_once('`')?.0.to_owned(),
                line,
            ))
        })
        .collect();
    let (_, context) = rig_file::keys("rig.toml", &full(), &[], None).expect("TOML");
    let known = context.accessed();
    let listed: BTreeSet<String> = documented.keys().cloned().collect();
    assert_eq!(
        listed.difference(&known).collect::<Vec<_>>(),
        Vec::<&String>::new(),
        "documented, but not read"
    );
    assert_eq!(
        known.difference(&listed).collect::<Vec<_>>(),
        Vec::<&String>::new(),
        "read, but not documented"
    );
    let tested: BTreeSet<String> = KEYS
        .iter()
        .map(|(key, ..)| {
            let names = [
                "camera.wrist",
                "range.lidar",
                "arm.bus.can0",
                "base.tag.7",
                "sim.target.board",
            ];
            let motors = [
                "arm.motor.first",
                "arm.motor.second",
                "arm.motor.third",
                "arm.servo.first",
            ];
            names
                .iter()
                .chain(&motors)
                .fold((*key).to_owned(), |key, named| {
                    let (table, _) = named.rsplit_once('.').expect("two parts");
                    key.replace(named, &format!("{table}.NAME"))
                })
        })
        .collect();
    assert_eq!(
        known.difference(&tested).collect::<Vec<_>>(),
        Vec::<&String>::new(),
        "read, but not tested above"
    );
    for (key, line) in documented {
        let cells = line
            .split('|')
            .filter(|cell| !cell.trim().is_empty())
            .count();
        assert_eq!(cells, 4, "{key}: key, meaning, default, allowed");
    }
}

/// An effective rig file, which has every table.
pub(super) fn full() -> String {
    let measured = Override::new("base.world_from_base.xyz_m", Value::from(vec![0.0; 3]));
    parse(RIG, &[measured]).expect("a good rig file").to_toml()
}

#[test]
fn documented_defaults_match_the_code() {
    let page = include_str!("../../../docs/reference/rig.md");
    let rig = parse(RIG, &[]).expect("a good rig file");
    let resolved: toml::Table = toml::from_str(&rig.to_toml()).expect("TOML");
    let mut n_checked = 0;
    let is_checked = |line: &&str| {
        (line.starts_with("| `join.") || line.starts_with("| `camera.NAME.sim."))
            && !line.contains(".sim.truth.")
    };
    for line in page.lines().filter(is_checked) {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        let key = cells[1].trim_matches('`').replace("NAME", "wrist");
        let resolved = Value::Table(resolved.clone());
        let value = key
            .split('.')
            .try_fold(&resolved, |table, part| table.get(part));
        // A default that depends on the run is described in words, and is not in the resolved file.
        let number = value.map(|value| {
            value
                .as_float()
                .or_else(|| value.as_integer().map(|whole| whole as f64))
                .expect("a number")
        });
        assert_eq!(cells[3].parse::<f64>().ok(), number, "{key}");
        n_checked += 1;
    }
    assert_eq!(n_checked, 26, "[join] and [camera.NAME.sim]");
}

#[test]
fn unknown_key_error_gives_line_and_nearest_key() {
    let cases = [
        (
            "flange_lnk = \"c\"",
            "flange_link = \"c\"",
            5,
            "arm.flange_lnk",
            Some("arm.flange_link"),
        ),
        (
            "rate_herz = 30",
            "rate_hz = 30",
            9,
            "camera.wrist.rate_herz",
            Some("camera.wrist.rate_hz"),
        ),
        ("[trian]", "[train]", 20, "trian", Some("train")),
        (
            "quat_xyz =",
            "quat_xyzw =",
            11,
            "camera.wrist.parent_from_camera.quat_xyz",
            Some("camera.wrist.parent_from_camera.quat_xyzw"),
        ),
        ("[sim]\nzebra = 1", "[sim]", 22, "sim.zebra", None),
    ];
    for (invalid, right, expected_line, expected_key, expected_nearest) in cases {
        let error = parse(&RIG.replacen(right, invalid, 1), &[]).expect_err(invalid);
        let message = error.to_string();
        match error {
            ConfigError::UnknownKey { key, nearest, .. } => {
                assert_eq!(
                    (key.as_str(), nearest.as_deref()),
                    (expected_key, expected_nearest),
                    "{message}"
                );
            }
            other => panic!("{invalid}: {other}"),
        }
        assert!(
            message.starts_with(&format!("rig.toml line {expected_line}: ")),
            "{message}"
        );
    }
}

#[test]
fn missing_keys_and_syntax_errors_are_reported() {
    for key in [
        "driver",
        "urdf",
        "flange_link",
        "size_px",
        "rate_hz",
        "parent",
    ] {
        let without: String = RIG
            .lines()
            .filter(|line| !line.starts_with(&format!("{key} =")))
            .map(|line| format!("{line}\n"))
            .collect();
        let message = parse(&without, &[]).expect_err(key).to_string();
        assert!(
            message.contains("is missing") && message.contains(key),
            "{message}"
        );
    }
    let message = parse("[arm]\ndriver = \"sim\nurdf = 3", &[])
        .expect_err("no closing quote")
        .to_string();
    assert!(message.starts_with("rig.toml line 2: "), "{message}");
    let message = parse("[arm]\ndriver = \"none\"\n", &[])
        .expect_err("no device")
        .to_string();
    assert!(message.contains("[camera.NAME]"), "{message}");
    let missing = Rig::load(Path::new("no/such/rig.toml"), &[])
        .expect_err("no file")
        .to_string();
    assert!(missing.contains("no/such/rig.toml"), "{missing}");
}

#[test]
fn invalid_value_error_names_line_or_flag() {
    let message = parse(&RIG.replace("rate_hz = 30", "rate_hz = 3000"), &[])
        .expect_err("too fast")
        .to_string();
    assert_eq!(
        message,
        "rig.toml line 9: camera.wrist.rate_hz is 3000, allowed: numbers from 0.01 to 1000"
    );
    let message = parse(RIG, &[Override::new("train.sh_degree", 9)])
        .expect_err("no such degree")
        .to_string();
    assert_eq!(
        message,
        "command line: train.sh_degree is 9, allowed: whole numbers from 0 to 3"
    );
}

#[test]
fn unknown_arm_driver_error_names_the_driver_for_other_arms() {
    let message = parse(
        &RIG.replacen("driver = \"sim\"", "driver = \"xarm\"", 1),
        &[],
    )
    .expect_err("no such driver")
    .to_string();
    assert!(
        message.contains(
            "arm.driver is \"xarm\", allowed: \"none\", \"franka\", \"ur\", \"can\", \"feetech\", \"dynamixel\", \
             \"udp\", \"sim\"; for another arm, use \"udp\""
        ) && message.contains("docs/guide/arms.md"),
        "{message}"
    );
    // Cameras have other drivers.
    let message = parse(
        &RIG.replacen("driver = \"v4l2\"", "driver = \"feetech\"", 1),
        &[],
    )
    .expect_err("no such driver")
    .to_string();
    assert!(!message.contains("another arm"), "{message}");
}

#[test]
fn bundled_rig_files_are_valid_and_round_trip() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs");
    let mut n_rigs = 0;
    for entry in std::fs::read_dir(&folder).expect("the folder rigs") {
        let path = entry.expect("a file").path();
        if path.extension().is_none_or(|ending| ending != "toml") {
            continue;
        }
        n_rigs += 1;
        let rig = Rig::load(&path, &[]).unwrap_or_else(|e| panic!("{e}"));
        let resolved = tempfile::tempdir().expect("a folder");
        let again = Rig::load(
            &rig.write_resolved(resolved.path())
                .expect("the folder is writable"),
            &[],
        );
        assert_eq!(again.unwrap_or_else(|e| panic!("{e}")), rig, "{path:?}");
    }
    assert!(n_rigs >= 3, "{n_rigs} rig files");
}

#[test]
fn pinhole_with_nonzero_coefficients_is_rejected() {
    let pinhole = RIG.replace("brown_conrady", "pinhole");
    assert!(parse(&pinhole, &[]).is_ok());
    let distorted = pinhole.replacen("[0, 0, 0, 0, 0]", "[0.1, 0, 0, 0, 0]", 1);
    let message = parse(&distorted, &[])
        .expect_err("a bent pinhole")
        .to_string();
    assert!(
        message.contains("camera.wrist.intrinsics.distortion")
            && message.contains("lens = \"pinhole\""),
        "{message}"
    );
}

#[test]
fn tag_ids_are_limited_by_family() {
    let numbered = |id: u32| {
        parse(
            &RIG.replace("[base.tag.7]", &format!("[base.tag.{id}]")),
            &[],
        )
    };
    assert!(numbered(586).is_ok());
    let refused = numbered(587).expect_err("outside tag36h11").to_string();
    assert!(
        refused.contains("base.tag.587") && refused.contains("0 to 586"),
        "{refused}"
    );
}

#[test]
fn can_arm_needs_one_motor_per_joint() {
    let text = |joints: [&str; 2]| {
        let [first, second] = joints;
        format!(
            "[arm]\ndriver = \"can\"\nurdf = \"two.urdf\"\nflange_link = \"c\"\n[arm.bus.can0]\n\
             [arm.motor.{first}]\nfamily = \"damiao\"\nbus = \"can0\"\nid = 2\nfeedback_id = 18\n\
             [arm.motor.{second}]\nfamily = \"odrive\"\nbus = \"can0\"\nid = 1\n\
             [camera.front]\ndriver = \"sim\"\nsize_px = [640, 480]\nrate_hz = 30\nparent = \"base\"\n\
             intrinsics = {{ focal_px = [600, 600], principal_px = [320, 240] }}\n"
        )
    };
    let rig = |joints| {
        parse(
            &text(joints),
            &[Override::new("arm.joints", Value::from(vec!["j2", "j1"]))],
        )
    };
    let good = rig(["j1", "j2"]).expect("a motor for each joint");
    assert_eq!(
        good.arm
            .motors
            .iter()
            .map(|motor| motor.joint.as_str())
            .collect::<Vec<_>>(),
        ["j2", "j1"]
    );
    let refused = rig(["j1", "j3"]).expect_err("no such joint").to_string();
    assert!(
        refused.contains("\"j3\" is not one of the joints j2, j1"),
        "{refused}"
    );
    let same = parse(
        &text(["j1", "j2"]).replace("odrive\"", "damiao\"\nfeedback_id = 18"),
        &[],
    );
    let refused = same.expect_err("both send feedback as 18").to_string();
    assert!(
        refused.contains("\"j1\" and \"j2\" have the same ID on \"can0\""),
        "{refused}"
    );
    let answers = parse(
        &text(["j1", "j2"]).replace("odrive\"", "damiao\"\nfeedback_id = 2"),
        &[],
    );
    let refused = answers
        .expect_err("the first would take the feedback of the second for commands")
        .to_string();
    assert!(refused.contains("the same ID"), "{refused}");
    let named = |interface: &str| {
        let text = text(["j1", "j2"]).replace("arm.bus.can0", &format!("arm.bus.{interface:?}"));
        parse(&text.replace("\"can0\"", &format!("{interface:?}")), &[])
    };
    assert!(named("can-first").is_ok());
    for invalid in ["", "can/0", "can 0", "a_name_of_sixteen"] {
        let refused = named(invalid)
            .expect_err("not an interface name")
            .to_string();
        assert!(
            refused.contains("1 to 15 characters"),
            "{invalid}: {refused}"
        );
    }
    let other = text(["j1", "j2"]).replace("odrive\"", "robstride\"\nmodel = \"ak80-9\"");
    let refused = parse(&other, &[])
        .expect_err("a model of another family")
        .to_string();
    assert!(
        refused.ends_with(
            r#"arm.motor.j2.model is "ak80-9", allowed: "rs00", "rs01", "rs02", "rs03", "rs04", "rs05", "rs06""#
        ),
        "{refused}"
    );
    let refused = with("arm.driver", "'can'")
        .expect_err("no motors for its joints")
        .to_string();
    assert!(refused.contains("arm.motor"), "{refused}");
    let foreign = with("arm.motor.first.model", "'rs01'")
        .expect_err("Damiao motors report their model")
        .to_string();
    assert!(foreign.contains("arm.motor.first.model"), "{foreign}");
}

#[test]
fn absurd_files_are_refused_quickly_with_few_problems() {
    let load = |text: &str| {
        Rig::parse("rig.toml", text, URDF, &[])
            .expect_err("absurd")
            .to_string()
    };
    let unknown: String = (0..200_000).map(|n| format!("key{n} = 1\n")).collect();
    let message = load(&format!("{unknown}{RIG}"));
    assert!(
        message.starts_with("rig.toml line 1: unknown key \"key0\""),
        "{}",
        &message[..200]
    );
    assert!(
        message.lines().count() < 60 && message.ends_with("and 199950 more problems"),
        "{} lines",
        message.lines().count()
    );
    let cameras: String = (0..20_000)
        .map(|n| format!("[camera.c{n}]\ndriver = \"v4l2\"\n"))
        .collect();
    let message = load(&format!("{RIG}{cameras}"));
    assert!(
        message.contains("camera is \"20001 tables\", allowed: at most 1000 tables"),
        "{message}"
    );
}
