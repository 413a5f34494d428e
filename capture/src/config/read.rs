//! Reads the text of a rig file into a checked rig: every key with its default and range.

use super::section::{ParseContext, Section};
use super::{
    Arm, ArmDriver, Base, BaseDriver, Camera, CameraDriver, CameraSim, ConfigError, DEFAULT_SEED, Depth, JoinConfig,
    MAX_BYTES_RANGE, MAX_SPLATS_RANGE, Methods, Override, Parent, Realsense, Rig, SEED_RANGE, Scanner, ScannerDriver,
    ScannerSim, Sim, TimeOffset, Train, UnknownCalibration, V4l2,
};
use drivers::can::MotorConfig;
use drivers::realsense::{Filter, Pace, Stream};
use drivers::tags::{Family, TagPlacement};
use drivers::v4l2::{Delivery, V4l2Format};
use kinematics::{Chain, Intrinsics, Lens, Transform};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use toml::{Table, Value};

pub(super) const ARM_DRIVERS: [(&str, ArmDriver); 5] = [
    ("none", ArmDriver::None),
    ("franka", ArmDriver::Franka),
    ("can", ArmDriver::Can),
    ("udp", ArmDriver::Udp),
    ("sim", ArmDriver::Sim),
];
pub(super) const BASE_DRIVERS: [(&str, BaseDriver); 5] = [
    ("fixed", BaseDriver::Fixed),
    ("tags", BaseDriver::Tags),
    ("rgbd", BaseDriver::Rgbd),
    ("udp", BaseDriver::Udp),
    ("sim", BaseDriver::Sim),
];
pub(super) const TAG_FAMILIES: [(&str, Family); 5] = [
    ("tag36h11", Family::Tag36h11),
    ("tag25h9", Family::Tag25h9),
    ("tag16h5", Family::Tag16h5),
    ("tagStandard41h12", Family::Standard41h12),
    ("tagStandard52h13", Family::Standard52h13),
];
pub(super) const CAMERA_DRIVERS: [(&str, CameraDriver); 4] = [
    ("realsense", CameraDriver::Realsense),
    ("v4l2", CameraDriver::V4l2),
    ("nokhwa", CameraDriver::Nokhwa),
    ("sim", CameraDriver::Sim),
];
pub(super) const DELIVERIES: [(&str, Delivery); 2] = [("every", Delivery::Every), ("newest", Delivery::Newest)];
pub(super) const PACES: [(&str, Pace); 3] =
    [("real_time", Pace::RealTime), ("fast", Pace::Fast), ("clock", Pace::Clock)];
pub(super) const STREAMS: [(&str, Stream); 2] = [("color", Stream::Color), ("infrared", Stream::Infrared)];
pub(super) const FILTERS: [(&str, Filter); 3] =
    [("spatial", Filter::Spatial), ("temporal", Filter::Temporal), ("hole_filling", Filter::HoleFilling)];
pub(super) const SCANNER_DRIVERS: [(&str, ScannerDriver); 2] =
    [("udp", ScannerDriver::Udp), ("sim", ScannerDriver::Sim)];
pub(super) const PARENTS: [(&str, Parent); 3] =
    [("flange", Parent::Flange), ("base", Parent::Base), ("world", Parent::World)];
/// The scene model that is trained if the rig file names none.
const DEFAULT_METHOD: &str = "splat";
/// Default addresses for base poses and range scans; they accept data from this computer only.
const DEFAULT_BASE_ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7009);
const DEFAULT_SCANNER_ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7010);
/// Robot description of a rig without an arm, if the rig file names none.
const EMPTY_URDF: &str = r#"<robot name="none"><link name="base"/></robot>"#;
/// Larger coordinates of poses and lenses are considered typing errors.
const MAX_COORDINATE: f64 = 1e4;
/// Maximum joint offset, rad or m.
const MAX_JOINT_OFFSET: f64 = 1.0;
/// A quaternion this close to unit length is not normalized, so that an effective rig file gives exactly the same rig.
const UNIT_NORM_TOLERANCE: f64 = 1e-12;

/// Reads a rig; `read_urdf` returns the robot description for the path in the file.
pub(super) fn rig(
    file: &str,
    text: &str,
    overrides: &[Override],
    read_urdf: impl FnOnce(&str) -> Result<String, ConfigError>,
) -> Result<Rig, ConfigError> {
    let (mut rig, urdf_path, context) = keys(file, text, overrides)?;
    if let Some(problem) = context.into_problem() {
        return Err(problem);
    }
    rig.arm.urdf_text = if urdf_path.is_empty() { EMPTY_URDF.to_owned() } else { read_urdf(&urdf_path)? };
    resolve_joints(file, &mut rig.arm)?;
    Ok(rig)
}

/// Reads all keys: the rig without its robot, the path of the robot description, and the problems found.
pub(super) fn keys(file: &str, text: &str, overrides: &[Override]) -> Result<(Rig, String, ParseContext), ConfigError> {
    let context = ParseContext::new(file, text, overrides.iter().map(|flag| flag.key.to_owned()).collect())?;
    let syntax =
        |e: toml::de::Error| ConfigError::Syntax { file: file.to_owned(), line: 1, message: e.message().to_owned() };
    let mut table: Table = toml::from_str(text).map_err(syntax)?;
    for flag in overrides {
        set(&mut table, flag.key, flag.value.clone());
    }
    let mut root = Section::root(&context, table);
    let (arm, urdf_path) = arm(root.section("arm"));
    let base = base(root.section("base"));
    let cameras = cameras(&mut root);
    let scanners = root.named_sections("range").into_iter().map(|(name, keys)| scanner(&name, keys)).collect();
    let join = join(root.section("join"));
    let train = train(root.section("train"));
    let sim = sim(root.section("sim"));
    root.end();
    Ok((Rig { arm, base, cameras, scanners, join, train, sim }, urdf_path, context))
}

/// Sets the value of a dotted key and creates missing tables.
fn set(table: &mut Table, key: &str, value: Value) {
    match key.split_once('.') {
        None => {
            table.insert(key.to_owned(), value);
        }
        Some((parent, rest)) => {
            let inner = table.entry(parent.to_owned()).or_insert_with(|| Value::Table(Table::new()));
            if let Value::Table(inner) = inner {
                set(inner, rest, value);
            }
        }
    }
}

/// Checks links and joints against the robot description and fills in the joints if the rig file lists none.
fn resolve_joints(file: &str, arm: &mut Arm) -> Result<(), ConfigError> {
    let robot = |key, e: kinematics::Error| ConfigError::Robot { file: file.to_owned(), key, reason: e.to_string() };
    if arm.base_link.is_empty() {
        let description = kinematics::urdf::Robot::parse(&arm.urdf_text).map_err(|e| robot("arm.urdf", e))?;
        arm.base_link = description.root().map_err(|e| robot("arm.urdf", e))?.to_owned();
    }
    let chain =
        Chain::from_urdf(&arm.urdf_text, &arm.base_link, &arm.flange_link).map_err(|e| robot("arm.flange_link", e))?;
    if arm.joints.is_empty() {
        arm.joints = chain.joint_names().to_vec();
    }
    chain.order_in(&arm.joints).map_err(|e| robot("arm.joints", e))?;
    resolve_motors(file, arm)?;
    let (n, n_joints) = (arm.joint_offsets.len(), arm.joints.len());
    if n == 0 || (n == n_joints && arm.joint_offsets.iter().all(|offset| offset.abs() <= MAX_JOINT_OFFSET)) {
        return Ok(());
    }
    let reason = format!("{n} numbers; must be {n_joints} from -{MAX_JOINT_OFFSET} to {MAX_JOINT_OFFSET}, or none");
    Err(ConfigError::Robot { file: file.to_owned(), key: "arm.joint_offsets", reason })
}

/// Sorts the motors by joint. An arm on CAN buses needs exactly one motor per joint.
fn resolve_motors(file: &str, arm: &mut Arm) -> Result<(), ConfigError> {
    if arm.driver != ArmDriver::Can {
        return Ok(());
    }
    let problem = |reason| ConfigError::Robot { file: file.to_owned(), key: "arm.motor", reason };
    let index_of = |name: &String| arm.joints.iter().position(|joint| joint == name);
    if let Some(unknown_motor) = arm.motors.iter().find(|motor| index_of(&motor.joint).is_none()) {
        return Err(problem(format!("{:?} is not one of the joints {}", unknown_motor.joint, arm.joints.join(", "))));
    }
    if let Some(joint) = arm.joints.iter().find(|joint| !arm.motors.iter().any(|motor| motor.joint == **joint)) {
        return Err(problem(format!("the joint {joint:?} has no table [arm.motor.{joint}]")));
    }
    for (ix, motor) in arm.motors.iter().enumerate() {
        let is_same =
            |other: &&MotorConfig| other.bus_ix == motor.bus_ix && other.protocol.conflicts_with(&*motor.protocol);
        if let Some(same) = arm.motors[..ix].iter().find(is_same) {
            let interface = &arm.buses[motor.bus_ix].interface;
            let message = format!("{:?} and {:?} have the same ID on {interface:?}", same.joint, motor.joint);
            return Err(problem(message));
        }
    }
    let mut motors = std::mem::take(&mut arm.motors);
    motors.sort_by_key(|motor| index_of(&motor.joint));
    arm.motors = motors;
    Ok(())
}

fn arm(mut keys: Section<'_>) -> (Arm, String) {
    let driver = keys.choice("driver", &ARM_DRIVERS);
    if driver.is_none() {
        keys.missing("driver", "none, franka, can, udp or sim");
    }
    let has_arm = driver != Some(ArmDriver::None);
    let urdf = keys.text("urdf");
    if urdf.is_none() && has_arm {
        keys.missing("urdf", "path of the robot description, relative to the rig file");
    }
    // Without an arm and a robot description, the robot has a single link.
    let flange_link = keys.text("flange_link").or_else(|| (!has_arm && urdf.is_none()).then(|| "base".to_owned()));
    if flange_link.is_none() {
        keys.missing("flange_link", "link to which cameras with the parent flange are attached");
    }
    let (buses, motors) = super::can::read(&mut keys);
    let arm = Arm {
        driver: driver.unwrap_or(ArmDriver::Sim),
        address: keys.text("address").unwrap_or_default(),
        urdf_text: String::new(),
        joints: keys.texts("joints").unwrap_or_default(),
        joint_offsets: keys.number_list("joint_offsets").unwrap_or_default(),
        base_link: keys.text("base_link").unwrap_or_default(),
        flange_link: flange_link.unwrap_or_default(),
        max_speed_rad_s: keys.number("max_speed_rad_s", 0.001..=10.0).unwrap_or(0.5),
        rate_hz: keys.number("rate_hz", 1.0..=2000.0).unwrap_or(200.0),
        buses,
        motors,
        motion: keys.optional_section("motion").and_then(super::motion::read),
    };
    keys.end();
    (arm, urdf.unwrap_or_default())
}

fn base(mut keys: Section<'_>) -> Base {
    let tag_family = keys.choice("tag_family", &TAG_FAMILIES).unwrap_or(Family::Tag36h11);
    let tags = keys.named_sections("tag").into_iter().filter_map(|(id, keys)| tag(&id, tag_family, keys));
    let tags: BTreeMap<_, _> = tags.collect();
    let mut sim_keys = keys.section("sim");
    let (drift_m, drift_rad) = (sim_keys.number("drift_m", 0.0..=10.0), sim_keys.number("drift_rad", 0.0..=1.0));
    sim_keys.end();
    let driver = keys.choice("driver", &BASE_DRIVERS).unwrap_or(BaseDriver::Fixed);
    if driver == BaseDriver::Tags && tags.is_empty() {
        keys.missing("tag", "a table [base.tag.ID] for each tag, with size_m and world_from_tag");
    }
    let base = Base {
        driver,
        address: keys.address("address").unwrap_or(DEFAULT_BASE_ADDRESS),
        world_from_base: pose(&mut keys, "world_from_base").unwrap_or_else(Transform::identity),
        rate_hz: keys.number("rate_hz", 1.0..=1000.0).unwrap_or(100.0),
        realign: keys.flag("realign").unwrap_or(true),
        max_sigma_m: keys.number("max_sigma_m", 0.0001..=100.0).unwrap_or(0.05),
        max_sigma_rad: keys.number("max_sigma_rad", 0.0001..=3.2).unwrap_or(0.03),
        tag_family,
        tags,
        drift_m: drift_m.unwrap_or(0.02),
        drift_rad: drift_rad.unwrap_or(0.0175),
    };
    keys.end();
    base
}

/// Reads a tag and its ID; returns `None` if a value is invalid, which has been reported.
fn tag(id: &str, family: Family, mut keys: Section<'_>) -> Option<(u32, TagPlacement)> {
    let number = id.parse().ok().filter(|number: &u32| number.to_string() == id && *number < family.n_tags());
    let allowed = format!("ID of a tag in its family, 0 to {}, as the name of the table", family.n_tags() - 1);
    let id = number.or_else(|| keys.invalid("id", &Value::from(id), &allowed));
    let size_m = keys.number("size_m", 0.001..=10.0);
    if size_m.is_none() {
        keys.missing("size_m", "side length of the tag's border, where black meets white, m");
    }
    let world_from_tag = pose(&mut keys, "world_from_tag").unwrap_or_else(Transform::identity);
    keys.end();
    Some((id?, TagPlacement { size_m: size_m?, world_from_tag }))
}

fn scanner(name: &str, mut keys: Section<'_>) -> Scanner {
    check_name(name, &keys);
    let driver = keys.choice("driver", &SCANNER_DRIVERS);
    if driver.is_none() {
        keys.missing("driver", "udp or sim");
    }
    let mut sim = keys.section("sim");
    let min_elevation_rad = sim.number("min_elevation_rad", -1.57..=1.57).unwrap_or(-0.2618);
    let scanner_sim = ScannerSim {
        rings: sim.whole("rings", 1..=256).map_or(16, to_u32),
        columns: sim.whole("columns", 4..=4096).map_or(900, to_u32),
        min_elevation_rad,
        max_elevation_rad: sim
            .number("max_elevation_rad", min_elevation_rad..=1.57)
            .unwrap_or(min_elevation_rad.max(0.2618)),
        noise_sigma_m: sim.number("noise_sigma_m", 0.0..=1.0).unwrap_or(0.02),
        dropped_frac: sim.number("dropped_frac", 0.0..=0.9).unwrap_or(0.01),
    };
    sim.end();
    let min_m = keys.number("min_m", 0.0..=100.0).unwrap_or(0.4);
    let scanner = Scanner {
        name: name.into(),
        driver: driver.unwrap_or(ScannerDriver::Sim),
        address: keys.address("address").unwrap_or(DEFAULT_SCANNER_ADDRESS),
        rate_hz: keys.number("rate_hz", 0.1..=50.0).unwrap_or(10.0),
        base_from_scanner: pose(&mut keys, "base_from_scanner").unwrap_or_else(Transform::identity),
        min_m,
        max_m: keys.number("max_m", min_m..=1000.0).unwrap_or(min_m.max(50.0)),
        sim: scanner_sim,
    };
    keys.end();
    scanner
}

/// Checks a name that is also used for frames and topics.
fn check_name(name: &str, keys: &Section<'_>) {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if name.is_empty() || !name.chars().all(plain) {
        keys.invalid::<()>("name", &Value::String(name.to_owned()), "letters, digits, _ and -");
    }
}

fn cameras(root: &mut Section<'_>) -> Vec<Camera> {
    let sections = root.named_sections("camera");
    if sections.is_empty() {
        root.missing("camera", "at least one table [camera.NAME]");
    }
    sections.into_iter().map(|(name, keys)| camera(&name, keys)).collect()
}

fn camera(name: &str, mut keys: Section<'_>) -> Camera {
    check_name(name, &keys);
    let driver = keys.choice("driver", &CAMERA_DRIVERS);
    if driver.is_none() {
        keys.missing("driver", "realsense, v4l2, nokhwa or sim");
    }
    let size_px = size_px(&mut keys);
    if size_px.is_none() {
        keys.missing("size_px", "width and height of the images");
    }
    let rate_hz = keys.number("rate_hz", 0.01..=1000.0);
    if rate_hz.is_none() {
        keys.missing("rate_hz", "images per second");
    }
    let parent = keys.choice("parent", &PARENTS);
    if parent.is_none() {
        keys.missing("parent", "flange, base or world");
    }
    let rectified = keys.flag("rectified").unwrap_or(false);
    let intrinsics = intrinsics(&mut keys, size_px.unwrap_or([1, 1]), rectified);
    // RealSense cameras report their intrinsics.
    let mut unknown = UnknownCalibration { intrinsics: intrinsics.is_none(), ..UnknownCalibration::default() };
    if unknown.intrinsics && driver != Some(CameraDriver::Realsense) {
        keys.missing("intrinsics", "focal_px, principal_px and, for a lens with distortion, lens and distortion");
    }
    let intrinsics = intrinsics.unwrap_or(Intrinsics { size_px: size_px.unwrap_or([1, 1]), ..PLACEHOLDER_INTRINSICS });
    let depth = keys.optional_section("depth").map(|keys| depth(keys, &intrinsics, &mut unknown));
    if driver != Some(CameraDriver::Realsense) {
        unknown = UnknownCalibration::default();
    }
    let period_micros = 1e6 / rate_hz.unwrap_or(1.0);
    let camera = Camera {
        name: name.into(),
        driver: driver.unwrap_or(CameraDriver::Sim),
        device: keys.text("device").unwrap_or_default(),
        rate_hz: rate_hz.unwrap_or(1.0),
        exposure_micros: keys.number("exposure_micros", 0.0..=period_micros),
        readout_micros: keys.number("readout_micros", 0.0..=period_micros),
        stamp_to_mid_exposure: keys.optional_section("stamp_to_mid_exposure_millis").map(time_offset),
        parent: parent.unwrap_or(Parent::Flange),
        parent_from_camera: pose(&mut keys, "parent_from_camera").unwrap_or_else(Transform::identity),
        depth,
        v4l2: v4l2(keys.section("v4l2")),
        realsense: realsense(keys.section("realsense"), unknown),
        sim: camera_sim(keys.section("sim")),
        intrinsics,
    };
    keys.end();
    camera
}

/// Placeholder until the missing key is reported, or until the camera reports its intrinsics.
const PLACEHOLDER_INTRINSICS: Intrinsics =
    Intrinsics { size_px: [1, 1], focal_px: [1.0; 2], principal_px: [0.5; 2], lens: Lens::Pinhole, rectified: true };

fn size_px(keys: &mut Section<'_>) -> Option<[u32; 2]> {
    let [width, height] = keys.numbers::<2>("size_px", 8.0..=16384.0)?;
    if width.fract() != 0.0 || height.fract() != 0.0 {
        return keys.invalid("size_px", &Value::from(vec![width, height]), "whole numbers");
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "whole numbers up to 16384")]
    Some([width as u32, height as u32])
}

fn intrinsics(keys: &mut Section<'_>, size_px: [u32; 2], rectified: bool) -> Option<Intrinsics> {
    const LENSES: [(&str, &str); 3] =
        [("pinhole", "pinhole"), ("brown_conrady", "brown_conrady"), ("kannala_brandt", "kannala_brandt")];
    let mut keys = keys.optional_section("intrinsics")?;
    let focal_px = keys.numbers::<2>("focal_px", 1.0..=1e6);
    if focal_px.is_none() {
        keys.missing("focal_px", "focal length along x and y in pixels");
    }
    let principal_px = keys.numbers::<2>("principal_px", -MAX_COORDINATE..=3.0 * MAX_COORDINATE);
    if principal_px.is_none() {
        keys.missing("principal_px", "principal point in pixels; the center of the first pixel is (0.5, 0.5)");
    }
    let name = keys.choice("lens", &LENSES).unwrap_or("pinhole");
    let distortion = keys.number_list("distortion").unwrap_or_default();
    let lens = match (name, &distortion[..]) {
        // Some drivers print a pinhole as five zeros.
        ("pinhole", coefficients) if coefficients.iter().all(|k| *k == 0.0) => Some(Lens::Pinhole),
        ("pinhole", _) => keys.invalid(
            "distortion",
            &Value::from(distortion.clone()),
            "none with lens = \"pinhole\"; set lens to brown_conrady or kannala_brandt",
        ),
        ("brown_conrady", [k1, k2, p1, p2, k3]) => Some(Lens::BrownConrady([*k1, *k2, *p1, *p2, *k3])),
        ("kannala_brandt", [k1, k2, k3, k4]) => Some(Lens::KannalaBrandt([*k1, *k2, *k3, *k4])),
        _ => keys.invalid(
            "distortion",
            &Value::from(distortion.clone()),
            "5 (k1, k2, p1, p2, k3) for brown_conrady, 4 (k1, k2, k3, k4) for kannala_brandt",
        ),
    };
    keys.end();
    Some(Intrinsics { size_px, focal_px: focal_px?, principal_px: principal_px?, lens: lens?, rectified })
}

fn time_offset(mut keys: Section<'_>) -> TimeOffset {
    let value_millis = keys.number("value", -1000.0..=1000.0);
    if value_millis.is_none() {
        keys.missing("value", "milliseconds from the stamp to mid-exposure");
    }
    let time_offset = TimeOffset {
        value_millis: value_millis.unwrap_or_default(),
        sigma_millis: keys.number("sigma", 0.0..=1000.0).unwrap_or(0.0),
        source: keys.text("source").unwrap_or_default(),
    };
    keys.end();
    time_offset
}

fn depth(mut keys: Section<'_>, color: &Intrinsics, unknown: &mut UnknownCalibration) -> Depth {
    let size_px = size_px(&mut keys).unwrap_or(color.size_px);
    let rectified = keys.flag("rectified").unwrap_or(color.rectified);
    // Depth of the same size as the color image is registered to it; depth of another size is assumed to have the same
    // field of view.
    let intrinsics = intrinsics(&mut keys, size_px, rectified);
    unknown.depth_intrinsics = intrinsics.is_none();
    let intrinsics = intrinsics.unwrap_or_else(|| Intrinsics {
        rectified,
        ..if size_px == color.size_px { color.clone() } else { color.resized(size_px) }
    });
    let camera_from_depth = pose(&mut keys, "camera_from_depth");
    unknown.camera_from_depth = camera_from_depth.is_none();
    let min_m = keys.number("min_m", 0.0..=100.0).unwrap_or(0.1);
    let depth = Depth {
        device: keys.text("device").unwrap_or_default(),
        meters_per_count: keys.number("meters_per_count", 1e-6..=0.1),
        intrinsics,
        camera_from_depth: camera_from_depth.unwrap_or_else(Transform::identity),
        factor: keys.number("factor", 0.5..=2.0).unwrap_or(1.0),
        min_m,
        max_m: keys.number("max_m", min_m..=1000.0).unwrap_or(6.0),
    };
    keys.end();
    depth
}

/// Controls are 32 bits wide; the camera's own limits are checked when it is opened.
const CONTROL_RANGE: std::ops::RangeInclusive<i64> = -1_000_000..=1_000_000;

fn to_i32(number: i64) -> i32 {
    i32::try_from(number).expect("the range was checked")
}

fn realsense(mut keys: Section<'_>, unknown: UnknownCalibration) -> Realsense {
    let realsense = Realsense {
        file: keys.text("file").unwrap_or_default().into(),
        pace: keys.choice("pace", &PACES).unwrap_or_default(),
        clock_offset_nanos: keys.integer("clock_offset_nanos", -i64::MAX..=i64::MAX).unwrap_or(0),
        stream: keys.choice("stream", &STREAMS).unwrap_or_default(),
        gain: keys.integer("gain", CONTROL_RANGE).map(to_i32),
        brightness: keys.integer("brightness", CONTROL_RANGE).map(to_i32),
        white_balance_kelvin: keys.integer("white_balance_kelvin", 1000..=20_000).map(to_i32),
        preset: keys.text("preset"),
        laser_power: keys.number("laser_power", 0.0..=1000.0),
        filters: keys.choices_or_none("filters", &FILTERS).unwrap_or_default(),
        reconnect_secs: keys.number("reconnect_secs", 0.0..=86_400.0).unwrap_or(30.0),
        unknown,
    };
    keys.end();
    realsense
}

fn v4l2(mut keys: Section<'_>) -> V4l2 {
    let v4l2 = V4l2 {
        format: keys.choice("format", &V4l2Format::COLOR_FORMATS),
        gain: keys.integer("gain", CONTROL_RANGE).map(to_i32),
        brightness: keys.integer("brightness", CONTROL_RANGE).map(to_i32),
        white_balance_kelvin: keys.integer("white_balance_kelvin", 1000..=20_000).map(to_i32),
        delivery: keys.choice("delivery", &DELIVERIES).unwrap_or(Delivery::Every),
        reconnect_secs: keys.number("reconnect_secs", 0.0..=86_400.0).unwrap_or(30.0),
    };
    keys.end();
    v4l2
}

fn camera_sim(mut keys: Section<'_>) -> CameraSim {
    let sim = CameraSim {
        noise_sigma: keys.number("noise_sigma", 0.0..=100.0).unwrap_or(2.0),
        shot_frac: keys.number("shot_frac", 0.0..=1.0).unwrap_or(0.7),
        blur_samples: keys.whole("blur_samples", 1..=64).map_or(1, to_u32),
        latency_millis: keys.number("latency_millis", 0.0..=10_000.0).unwrap_or(20.0),
        dropped_frac: keys.number("dropped_frac", 0.0..=0.9).unwrap_or(0.0),
        supersample: keys.whole("supersample", 1..=4).map_or(1, to_u32),
        depth_noise_sigma_m: keys.number("depth_noise_sigma_m", 0.0..=1.0).unwrap_or(0.0015),
        depth_hole_frac: keys.number("depth_hole_frac", 0.0..=0.9).unwrap_or(0.02),
        meters_per_count: keys.number("meters_per_count", 1e-6..=0.1).unwrap_or(1e-4),
    };
    keys.end();
    sim
}

fn join(mut keys: Section<'_>) -> JoinConfig {
    let join = JoinConfig {
        start_keyframes: keys.whole("start_keyframes", 1..=100_000).map_or(5, to_usize),
        max_keyframes: keys.whole("max_keyframes", 8..=1_000_000).map_or(400, to_usize),
        max_bytes: keys.whole("max_bytes", 1_000_000..=1 << 50).unwrap_or(4_000_000_000),
        min_translation_m: keys.number("min_translation_m", 1e-6..=100.0).unwrap_or(0.02),
        min_rotation_rad: keys.number("min_rotation_rad", 1e-6..=3.2).unwrap_or(0.05),
        fixed_interval_millis: keys.number("fixed_interval_millis", 0.0..=1e9).unwrap_or(1000.0),
        fixed_keyframes: keys.whole("fixed_keyframes", 1..=1_000_000).map_or(16, to_usize),
        min_sharpness_frac: keys.number("min_sharpness_frac", 0.0..=1.0).unwrap_or(0.35),
        max_blur_px: keys.number("max_blur_px", 0.0..=1000.0).unwrap_or(1.5),
        max_shear_px: keys.number("max_shear_px", 0.0..=1000.0).unwrap_or(40.0),
        min_luma_frac: keys.number("min_luma_frac", 0.0..=1.0).unwrap_or(0.03),
        max_luma_frac: keys.number("max_luma_frac", 0.0..=1.0).unwrap_or(0.97),
        max_clipped_frac: keys.number("max_clipped_frac", 0.0..=1.0).unwrap_or(0.5),
        default_depth_m: keys.number("default_depth_m", 0.01..=1000.0).unwrap_or(0.5),
        max_gap_millis: keys.number("max_gap_millis", 0.1..=10_000.0).unwrap_or(50.0),
        max_wait_millis: keys.number("max_wait_millis", 1.0..=60_000.0).unwrap_or(500.0),
        max_range_scans: keys.whole("max_range_scans", 0..=1_000_000).map_or(200, to_usize),
    };
    keys.end();
    join
}

fn train(mut keys: Section<'_>) -> Train {
    let train = Train {
        methods: Methods {
            names: keys.words("method").unwrap_or_else(|| vec![DEFAULT_METHOD.to_owned()]),
            location: keys.location("method"),
        },
        max_splats: keys.whole("max_splats", MAX_SPLATS_RANGE),
        max_bytes: keys.whole("max_bytes", MAX_BYTES_RANGE),
        seed: keys.whole("seed", SEED_RANGE).unwrap_or(DEFAULT_SEED),
        sh_degree: keys.whole("sh_degree", 0..=3).map_or(3, to_u32),
        scale: keys.number("scale", 0.05..=1.0).unwrap_or(1.0),
    };
    keys.end();
    train
}

fn sim(mut keys: Section<'_>) -> Sim {
    let sim = Sim {
        scene: keys.text("scene").unwrap_or_else(|| "static-arm".to_owned()),
        seed: keys.whole("seed", SEED_RANGE).unwrap_or(DEFAULT_SEED),
        ideal: keys.flag("ideal").unwrap_or(false),
        lockstep: keys.flag("lockstep").unwrap_or(false),
        speed: keys.number("speed", 0.01..=2.0).unwrap_or(1.0),
        azimuth_only: keys.flag("azimuth_only").unwrap_or(false),
        duration_secs: keys.number("duration_secs", 0.001..=1e6),
        n_images: keys.whole("n_images", 1..=1_000_000_000),
        truth: keys.flag("truth").unwrap_or(true),
        truth_depth: keys.flag("truth_depth").unwrap_or(false),
        light_inside_frac: keys.number("light_inside_frac", 0.0..=4.0).unwrap_or(1.0),
    };
    keys.end();
    sim
}

fn pose(keys: &mut Section<'_>, key: &'static str) -> Option<Transform> {
    let mut keys = keys.optional_section(key)?;
    let [x, y, z] = keys.numbers::<3>("xyz_m", -MAX_COORDINATE..=MAX_COORDINATE).unwrap_or_default();
    let [i, j, k, w] = keys.numbers::<4>("quat_xyzw", -1.001..=1.001).unwrap_or([0.0, 0.0, 0.0, 1.0]);
    let quaternion = Quaternion::new(w, i, j, k);
    let norm = quaternion.norm();
    if (norm - 1.0).abs() > 1e-3 {
        keys.invalid::<()>("quat_xyzw", &Value::from(vec![i, j, k, w]), "numbers whose squares sum to 1");
    }
    keys.end();
    let rotation = match (norm - 1.0).abs() < UNIT_NORM_TOLERANCE {
        true => UnitQuaternion::new_unchecked(quaternion),
        false => UnitQuaternion::new_normalize(quaternion),
    };
    Some(Transform::from_parts(Translation3::new(x, y, z), rotation))
}

fn to_u32(number: u64) -> u32 {
    u32::try_from(number).expect("the range was checked")
}

fn to_usize(number: u64) -> usize {
    usize::try_from(number).expect("the range was checked")
}
