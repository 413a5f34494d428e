//! The masked robot of a stored keyframe, from which its mask can be drawn again.

use anyhow::{Context, ensure};
use keyframe::masked_robot::{ConvexPiece, HiddenPixels, MaskedRobot, Sweep, Uncertainty};
use kinematics::transform::{from_xyz_xyzw, to_xyz_xyzw};
use model_files::checkpoint::Array;
use nalgebra::Point3;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

const POINTS: &str = "robot_points_m.f64";
const HIDDEN_COLOR: &str = "hidden_color.u32";
const HIDDEN_DEPTH: &str = "hidden_depth.u32";
const HIDDEN_READINGS: &str = "hidden_depth_m.f32";
/// Number of coordinates of a point.
const N_AXES: usize = 3;

/// A masked robot without its arrays.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RobotDescription {
    rotation_error_rad: f64,
    position_error_m: f64,
    /// Number of points of each piece of each link.
    n_points: Vec<Vec<usize>>,
    during_color: Vec<SweepDescription>,
    during_depth: Vec<SweepDescription>,
    camera_from_depth: [f64; 7],
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SweepDescription {
    link: usize,
    camera_from_link: Vec<[f64; 7]>,
}

/// The description and the arrays of a robot.
pub(crate) fn to_stored(robot: &MaskedRobot) -> (RobotDescription, Vec<Array>) {
    let describe = |sweeps: &[Sweep]| -> Vec<SweepDescription> {
        let described = sweeps.iter().map(|sweep| SweepDescription {
            link: sweep.link_ix,
            camera_from_link: sweep.camera_from_link.iter().map(to_xyz_xyzw).collect(),
        });
        described.collect()
    };
    let n_points = robot.links.iter().map(|pieces| pieces.iter().map(Vec::len));
    let description = RobotDescription {
        rotation_error_rad: robot.uncertainty.rotation_rad,
        position_error_m: robot.uncertainty.position_m,
        n_points: n_points.map(Iterator::collect).collect(),
        during_color: describe(&robot.during_color),
        during_depth: describe(&robot.during_depth),
        camera_from_depth: to_xyz_xyzw(&robot.camera_from_depth),
    };
    let points = robot.links.iter().flatten().flatten();
    let coordinates = points.flat_map(|point| <[f64; N_AXES]>::from(point.coords));
    let HiddenPixels {
        color,
        depth,
        depth_m,
    } = &robot.hidden;
    let runs = |runs: &[[u32; 2]]| {
        runs.iter()
            .flatten()
            .flat_map(|n| n.to_le_bytes())
            .collect()
    };
    let arrays: [(&str, Vec<u8>); 4] = [
        (POINTS, coordinates.flat_map(f64::to_le_bytes).collect()),
        (HIDDEN_COLOR, runs(color)),
        (HIDDEN_DEPTH, runs(depth)),
        (
            HIDDEN_READINGS,
            depth_m
                .iter()
                .flat_map(|reading| reading.to_le_bytes())
                .collect(),
        ),
    ];
    let arrays = arrays.map(|(name, bytes)| Array {
        name: name.to_owned(),
        bytes,
    });
    (description, arrays.into())
}

/// The robot with this description.
///
/// * `shared`: links of a robot that was read before. They are shared if they are equal, because
///   all images of a camera have the same.
///
/// # Errors
///
/// Fails if an array is missing, or has a wrong length.
pub(crate) fn of_stored(
    description: &RobotDescription,
    arrays: &[Array],
    shared: &mut Option<Arc<[Vec<ConvexPiece>]>>,
) -> anyhow::Result<MaskedRobot> {
    let bytes_of = |name: &str| {
        let array = arrays.iter().find(|array| array.name == name);
        array
            .map(|array| array.bytes.as_slice())
            .with_context(|| format!("the array {name} is missing"))
    };
    let links = links_of(&description.n_points, bytes_of(POINTS)?)?;
    let links = match shared {
        Some(known) if **known == *links => Arc::clone(known),
        _ => Arc::clone(shared.insert(links.into())),
    };
    let sweeps = |described: &[SweepDescription]| -> Vec<Sweep> {
        let sweeps = described.iter().map(|sweep| Sweep {
            link_ix: sweep.link,
            camera_from_link: sweep
                .camera_from_link
                .iter()
                .map(|pose| from_xyz_xyzw(*pose))
                .collect(),
        });
        sweeps.collect()
    };
    let readings = bytes_of(HIDDEN_READINGS)?.as_chunks::<4>().0.iter();
    Ok(MaskedRobot {
        links,
        uncertainty: Uncertainty {
            rotation_rad: description.rotation_error_rad,
            position_m: description.position_error_m,
        },
        during_color: sweeps(&description.during_color),
        during_depth: sweeps(&description.during_depth),
        camera_from_depth: from_xyz_xyzw(description.camera_from_depth),
        hidden: HiddenPixels {
            color: runs_of(bytes_of(HIDDEN_COLOR)?),
            depth: runs_of(bytes_of(HIDDEN_DEPTH)?),
            depth_m: readings.map(|bytes| f32::from_le_bytes(*bytes)).collect(),
        },
    })
}

fn links_of(n_points: &[Vec<usize>], bytes: &[u8]) -> anyhow::Result<Vec<Vec<ConvexPiece>>> {
    let (coordinates, _) = bytes.as_chunks::<8>();
    let mut points = coordinates
        .as_chunks::<N_AXES>()
        .0
        .iter()
        .map(|point| Point3::from(point.map(f64::from_le_bytes)));
    let n_found = points.len();
    let n_described = n_points
        .iter()
        .flatten()
        .fold(0, |sum: usize, n| sum.saturating_add(*n));
    ensure!(
        n_found == n_described,
        "the array {POINTS} has {n_found} points, expected {n_described}"
    );
    let mut piece = |n: &usize| points.by_ref().take(*n).collect();
    Ok(n_points
        .iter()
        .map(|pieces| pieces.iter().map(&mut piece).collect())
        .collect())
}

fn runs_of(bytes: &[u8]) -> Vec<[u32; 2]> {
    let (numbers, _) = bytes.as_chunks::<4>();
    let (runs, _) = numbers.as_chunks::<2>();
    runs.iter().map(|run| run.map(u32::from_le_bytes)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Transform;

    #[test]
    fn robots_round_trip_bit_for_bit_and_share_their_links() {
        let point = |x: f64| Point3::new(x, 1.0 / 3.0, -0.1);
        let pose = Transform::translation(0.1, 1.0 / 7.0, 2.0);
        let robot = MaskedRobot {
            links: Arc::new([
                vec![vec![point(0.1), point(0.2)], vec![point(0.3)]],
                Vec::new(),
            ]),
            uncertainty: Uncertainty {
                rotation_rad: 0.1 / 3.0,
                position_m: 0.01,
            },
            during_color: vec![Sweep {
                link_ix: 0,
                camera_from_link: vec![pose, pose * pose],
            }],
            during_depth: Vec::new(),
            camera_from_depth: pose.inverse(),
            hidden: HiddenPixels {
                color: vec![[3, 4], [10, 1]],
                depth: vec![[2, 2]],
                depth_m: vec![1.0 / 3.0, 0.5],
            },
        };
        let (description, arrays) = to_stored(&robot);
        let text = serde_json::to_string(&description).expect("finite numbers");
        let description: RobotDescription = serde_json::from_str(&text).expect("JSON");
        let mut shared = None;
        let [one, other] =
            [0, 1].map(|_| of_stored(&description, &arrays, &mut shared).expect("complete arrays"));
        assert_eq!(one, robot);
        assert!(Arc::ptr_eq(&one.links, &other.links));
        let error = of_stored(&description, &arrays[1..], &mut None).expect_err("no points");
        assert!(error.to_string().contains("robot_points_m.f64 is missing"));
        let mut short = arrays;
        short[0].bytes.truncate(30);
        let error = of_stored(&description, &short, &mut None).expect_err("too few points");
        assert!(error.to_string().contains("has 1 points, expected 3"));
    }
}
