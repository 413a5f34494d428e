//! Voxels inside of capsules equal a test of each voxel.

use super::scene::{config, random_point};
use crate::capsules::{GridCapsule, RobotMask, in_grid};
use crate::grid::Grid;
use kinematics::Transform;
use nalgebra::Vector3;
use numbers::random::Random;
use steering::Capsule;

/// Depth in voxels below which rounding may decide.
const ROUNDING: f32 = 1e-2;

fn capsules(random: &mut Random, n: usize) -> Vec<Capsule> {
    let mut one = |ix: usize| {
        let start = random_point(random, 0.6);
        let along = match ix % 5 {
            0 => Vector3::zeros(),
            1 => Vector3::x() * 0.4,
            2 => Vector3::y() * -0.3,
            3 => Vector3::z() * 0.2,
            _ => random_point(random, 0.5),
        };
        Capsule {
            ends: [start, start + along],
            radius_m: random.uniform(0.01, 0.2),
        }
    };
    (0..n).map(&mut one).collect()
}

#[test]
fn rows_hold_exactly_the_voxels_inside() {
    let mut random = Random::new(31);
    let grid = Grid::around(&config(), &Vector3::zeros());
    let side = grid.side();
    for capsule in in_grid(
        &capsules(&mut random, 25),
        &Transform::identity(),
        &grid,
        0.0,
    ) {
        let mut is_inside = vec![false; side * side * side];
        capsule.rows(side, |span| {
            for x in span.x {
                is_inside[(span.z * side + span.y) * side + x] = true;
            }
        });
        for (ix, is_inside) in is_inside.iter().enumerate() {
            let at = [ix % side, ix / side % side, ix / (side * side)];
            let center = Vector3::from(at.map(|x| x as f32 + 0.5));
            let depth = capsule.depth(&center);
            assert!(
                depth.abs() < ROUNDING || *is_inside == (depth > 0.0),
                "{capsule:?} {at:?} {depth}"
            );
        }
    }
}

#[test]
fn mask_equals_a_test_of_all_capsules() {
    let mut random = Random::new(32);
    let grid = Grid::around(&config(), &Vector3::zeros());
    // More than 64, so that bits are shared.
    let all: Vec<GridCapsule> = in_grid(
        &capsules(&mut random, 90),
        &Transform::identity(),
        &grid,
        0.01,
    );
    for n in [1, 20, 90] {
        let mut mask = RobotMask::default();
        mask.set(&grid, all[..n].to_vec());
        let mut n_inside = 0;
        for _ in 0..20_000 {
            let point = grid.in_voxels(&random_point(&mut random, 0.9)).cast();
            let at = grid.voxel_of(&point).unwrap();
            let deepest = all[..n]
                .iter()
                .map(|capsule| capsule.depth(&point))
                .fold(-1.0, f32::max);
            let is_inside = mask.contains(&point, at.block);
            n_inside += i32::from(is_inside);
            assert!(
                deepest.abs() < ROUNDING || is_inside == (deepest > 0.0),
                "{point}"
            );
        }
        assert!(n_inside > 10, "{n_inside}");
    }
}
