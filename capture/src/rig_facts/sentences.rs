//! The facts of a rig in sentences.

use super::RigFacts;
use super::camera::{CameraFacts, FieldOfView, ScannerFacts};
use super::robot::ArmFacts;
use crate::config::{BaseDriver, Parent};
use kinematics::Transform;
use nalgebra::Vector3;
use std::f64::consts::PI;

/// Shorter offsets along an axis are not mentioned, meters.
const MIN_OFFSET_M: f64 = 0.0005;
/// Smaller rotations are not mentioned, radians.
const MIN_ANGLE_RAD: f64 = 0.5 / 180.0 * PI;

/// One sentence about a rig.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sentence {
    /// The sentence.
    pub text: String,
    /// What to do, if the sentence describes a probable mistake.
    pub remedy: Option<String>,
}

impl Sentence {
    fn fact(text: String) -> Self {
        Self { text, remedy: None }
    }
}

/// Describes frames and what moves with them, then each camera and each range scanner.
#[must_use]
pub fn sentences(facts: &RigFacts) -> Vec<Sentence> {
    let mut all = vec![base(facts)];
    all.push(facts.arm.as_ref().map_or_else(
        || Sentence::fact("No joint moves the flange: it moves with the base.".to_owned()),
        arm,
    ));
    for camera in &facts.cameras {
        all.push(place(camera));
        all.extend(mistake(camera));
        all.extend(sight(camera));
        all.push(images(camera));
    }
    all.extend(facts.scanners.iter().map(scanner));
    all
}

fn base(facts: &RigFacts) -> Sentence {
    let link = &facts.base_link;
    let source = match facts.base_driver {
        BaseDriver::Fixed => {
            return Sentence::fact(format!(
                "The base of the robot (link {link:?}) is fixed in the world, {}.",
                fixed_place(&facts.world_from_base)
            ));
        }
        BaseDriver::Tags => "AprilTags in the images",
        BaseDriver::Udp => "the datagrams of another program",
        BaseDriver::Sim => "the simulator",
        BaseDriver::Rgbd => "color and depth images",
    };
    Sentence::fact(format!(
        "The base of the robot (link {link:?}) moves in the world (x forward, y left, z up); its pose comes from {source}."
    ))
}

fn fixed_place(world_from_base: &Transform) -> String {
    let offset = &world_from_base.translation.vector;
    let place = if offset.norm() < MIN_OFFSET_M {
        "at its origin".to_owned()
    } else {
        format!("{} from its origin", offsets(offset, &WORLD_WORDS))
    };
    let angle_rad = world_from_base.rotation.angle();
    if angle_rad < MIN_ANGLE_RAD {
        place
    } else {
        format!(
            "{place} and rotated by {:.0} degrees",
            angle_rad.to_degrees()
        )
    }
}

fn arm(arm: &ArmFacts) -> Sentence {
    let heights = arm.reached_in_base.iter().map(|point| point.z);
    let [lowest_m, highest_m] = heights
        .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], z| {
            [low.min(z), high.max(z)]
        });
    let joints = if arm.n_joints == 1 { "joint" } else { "joints" };
    Sentence::fact(format!(
        "The flange (link {:?}) is moved by {} {joints} and reaches {} from the first of them; its height above the base is from {lowest_m:.2} to {highest_m:.2} m.",
        arm.flange_link,
        arm.n_joints,
        length(arm.reach_m)
    ))
}

fn place(camera: &CameraFacts) -> Sentence {
    let name = &camera.name;
    let attached = match camera.parent {
        Parent::Flange => "moves with the flange",
        Parent::Base => "moves with the base",
        Parent::World => "does not move in the world",
    };
    let Some((pose, axis)) = camera.parent_from_camera.zip(camera.axis_in_parent()) else {
        return Sentence::fact(format!("Camera {name:?} {attached}; its pose is unknown."));
    };
    let offset = &pose.translation.vector;
    let words = match camera.parent {
        Parent::Flange => &FLANGE_WORDS,
        Parent::Base | Parent::World => &WORLD_WORDS,
    };
    let place = if offset.norm() < MIN_OFFSET_M {
        "at the origin of this frame".to_owned()
    } else {
        format!(
            "{} from the origin of this frame ({})",
            length(offset.norm()),
            offsets(offset, words)
        )
    };
    let view = match camera.parent {
        Parent::Flange => flange_view(&axis, camera.toward_arm_in_flange.as_ref()),
        Parent::Base | Parent::World => world_view(&axis) + &roll(&pose),
    };
    Sentence::fact(format!(
        "Camera {name:?} {attached}, {place}, and looks {view}."
    ))
}

/// What a camera that is not on the flange sees.
fn sight(camera: &CameraFacts) -> Option<Sentence> {
    let mut parts = Vec::new();
    if let Some(ground_m) = camera.ground_at_m {
        parts.push(format!(
            "its optical axis meets the plane z = 0 {} away",
            length(ground_m)
        ));
    }
    if let Some(frac) = camera.seen_reach_frac {
        parts.push(format!(
            "{:.0} % of the positions that the flange reaches are inside its image",
            100.0 * frac
        ));
    }
    let text = parts.join("; ");
    (!parts.is_empty()).then(|| Sentence::fact(format!("Camera {:?}: {text}.", camera.name)))
}

/// The mistake of a camera that looks into the flange.
fn mistake(camera: &CameraFacts) -> Option<Sentence> {
    let at_m = camera.looks_into_flange_at_m?;
    let name = &camera.name;
    Some(Sentence {
        text: format!(
            "Camera {name:?} looks into the flange: its optical axis enters the last link of the arm after {}.",
            length(at_m)
        ),
        remedy: Some(format!(
            "correct camera.{name}.parent_from_camera: the z axis of the camera is its viewing direction, and the pose maps camera coordinates to the flange, not the other way round"
        )),
    })
}

fn images(camera: &CameraFacts) -> Sentence {
    let [width, height] = camera.size_px;
    let view = match (&camera.field_of_view, &camera.intrinsics) {
        (Some(view), _) => angles(view),
        (None, Some(_)) => "a field of view of at least half of the space".to_owned(),
        (None, None) if camera.reports_lens => {
            "a field of view that the camera reports when it is opened".to_owned()
        }
        (None, None) => "an unknown field of view".to_owned(),
    };
    let exposure = match camera.exposure_secs {
        Some(secs) => format!("exposed for {} ms", rounded(secs * 1e3)),
        None => "with automatic exposure".to_owned(),
    };
    let depth = match camera.depth_range_m {
        Some([nearest_m, farthest_m]) => {
            format!("depth from {} to {}", length(nearest_m), length(farthest_m))
        }
        None => "no depth".to_owned(),
    };
    Sentence::fact(format!(
        "Camera {:?} takes {} images per second of {width}x{height} pixels, {exposure}, with {view} and {depth}.",
        camera.name,
        rounded(camera.rate_hz)
    ))
}

fn angles(view: &FieldOfView) -> String {
    let diagonal = view.diagonal_rad.map_or_else(String::new, |rad| {
        format!(" ({:.0} across the diagonal)", rad.to_degrees())
    });
    format!(
        "a field of view of {:.0} x {:.0} degrees{diagonal}",
        view.horizontal_rad.to_degrees(),
        view.vertical_rad.to_degrees()
    )
}

fn scanner(scanner: &ScannerFacts) -> Sentence {
    let offset = &scanner.base_from_scanner.translation.vector;
    let place = if offset.norm() < MIN_OFFSET_M {
        "at its origin".to_owned()
    } else {
        format!(
            "{} from its origin ({})",
            length(offset.norm()),
            offsets(offset, &WORLD_WORDS)
        )
    };
    let [nearest_m, farthest_m] = scanner.range_m;
    Sentence::fact(format!(
        "Range scanner {:?} moves with the base, {place}, and makes {} scans per second, with ranges from {} to {}.",
        scanner.name,
        rounded(scanner.rate_hz),
        length(nearest_m),
        length(farthest_m)
    ))
}

/// Words for offsets along the positive and the negative axes.
type AxisWords = [[&'static str; 2]; 3];

/// World and base: x forward, y left, z up.
const WORLD_WORDS: AxisWords = [["forward", "back"], ["left", "right"], ["up", "down"]];
/// The axes of a flange have no common meaning.
const FLANGE_WORDS: AxisWords = [
    ["along x", "along -x"],
    ["along y", "along -y"],
    ["along z", "along -z"],
];

/// The parts of an offset along the axes.
fn offsets(offset: &Vector3<f64>, words: &AxisWords) -> String {
    let parts: Vec<String> = offset
        .iter()
        .zip(words)
        .filter(|(part_m, _)| part_m.abs() >= MIN_OFFSET_M)
        .map(|(part_m, [positive, negative])| {
            let word = if *part_m > 0.0 { positive } else { negative };
            format!("{} {word}", length(part_m.abs()))
        })
        .collect();
    parts.join(", ")
}

/// A viewing direction in a frame with x forward, y left and z up.
fn world_view(axis: &Vector3<f64>) -> String {
    /// Within this angle from the vertical, there is no horizontal direction.
    const VERTICAL_RAD: f64 = 5.0 / 180.0 * PI;
    let elevation_rad = axis.z.clamp(-1.0, 1.0).asin();
    if elevation_rad.abs() > 0.5 * PI - VERTICAL_RAD {
        return if axis.z > 0.0 {
            "straight up"
        } else {
            "straight down"
        }
        .to_owned();
    }
    let azimuth_deg = axis.y.atan2(axis.x).to_degrees();
    let side = if azimuth_deg > 0.0 { "left" } else { "right" };
    let horizontal = match azimuth_deg.abs() {
        ..1.0 => "forward".to_owned(),
        179.0.. => "back".to_owned(),
        89.0..91.0 => side.to_owned(),
        angle => format!("forward, rotated by {angle:.0} degrees to the {side}"),
    };
    let degrees = elevation_rad.to_degrees();
    match degrees {
        -1.0..1.0 => horizontal,
        1.0.. => format!("{horizontal}, {degrees:.0} degrees up"),
        _ => format!("{horizontal}, {:.0} degrees down", -degrees),
    }
}

/// The rotation of the image about the optical axis, as the end of a sentence; empty if the image is
/// upright.
fn roll(parent_from_camera: &Transform) -> String {
    /// Mounts are rarely more precise, and users do not care about less.
    const MIN_ROLL_DEG: f64 = 5.0;
    let up_in_camera = parent_from_camera.rotation.inverse() * Vector3::z();
    // A camera that looks straight up or down has no upright image.
    if up_in_camera.xy().norm() < 0.1 {
        return String::new();
    }
    // The y axis of an image points down.
    let roll_deg = up_in_camera.x.atan2(-up_in_camera.y).to_degrees();
    match roll_deg.abs() {
        ..MIN_ROLL_DEG => String::new(),
        175.0.. => "; its images are upside down".to_owned(),
        angle => format!("; its images are rotated by {angle:.0} degrees"),
    }
}

/// A viewing direction in the flange frame.
fn flange_view(axis: &Vector3<f64>, toward_arm: Option<&Vector3<f64>>) -> String {
    let [nearest, toward] = {
        let mut axes: Vec<usize> = vec![0, 1, 2];
        axes.sort_by(|one, other| axis[*other].abs().total_cmp(&axis[*one].abs()));
        [axes[0], axes[1]]
    };
    let word =
        |ix: usize| FLANGE_WORDS[ix][usize::from(axis[ix] < 0.0)].trim_start_matches("along ");
    let tilt_rad = axis[nearest].abs().clamp(0.0, 1.0).acos();
    let tilted = if tilt_rad < MIN_ANGLE_RAD {
        String::new()
    } else {
        format!(
            ", tilted by {:.0} degrees toward {}",
            tilt_rad.to_degrees(),
            word(toward)
        )
    };
    let relation = toward_arm.map_or("", |toward_arm| match axis.dot(toward_arm) {
        ..-0.5 => ", away from the arm",
        0.5.. => ", back toward the arm",
        _ => ", to the side of the arm",
    });
    format!("along {} of the flange{tilted}{relation}", word(nearest))
}

/// A length in the unit that people use for it.
fn length(length_m: f64) -> String {
    if length_m < 0.995 {
        format!("{:.0} mm", length_m * 1e3)
    } else {
        format!("{length_m:.2} m")
    }
}

/// A number with at most two decimals.
fn rounded(number: f64) -> String {
    let text = format!("{number:.2}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}
