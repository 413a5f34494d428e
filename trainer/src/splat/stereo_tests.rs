//! Depths from rendered images of scenes whose shape is known.
#![expect(
    clippy::cast_possible_truncation,
    reason = "cells and intensities are rounded down on purpose"
)]

use super::stereo::StereoImages;
use keyframe::{DepthMap, Keyframe, scenes};
use kinematics::Transform;
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use numbers::random::Random;
use std::sync::Arc;

const SIZE_PX: [u32; 2] = [160, 120];
const FOCAL_PX: f64 = 150.0;
/// Distance of the wall, and of the front of a box before its left half.
const WALL_M: f64 = 1.0;
const BOX_M: f64 = 0.6;

/// Distance along a ray, and whether the surface has a texture.
type Scene = fn(&Point3<f64>, &Vector3<f64>) -> (f64, Texture);

#[derive(Clone, Copy, PartialEq)]
enum Texture {
    Rough,
    Stripes,
    None,
}

/// Intensity of a texture at a point, 0 to 255: random values on a grid, interpolated.
fn intensity(texture: Texture, at: &Point3<f64>) -> u8 {
    const CELL_M: f64 = 0.02;
    let value = |cell: [i64; 2]| {
        let seed = (cell[0] * 7919 + cell[1] * 104_729).unsigned_abs();
        Random::new(seed).unit()
    };
    let grid = [at.x / CELL_M, at.y / CELL_M];
    let low = grid.map(f64::floor);
    let [right, down] = [grid[0] - low[0], grid[1] - low[1]];
    let [column, row] = low.map(|value| value as i64);
    let mix = |row| value([column, row]) * (1.0 - right) + value([column + 1, row]) * right;
    let rough = mix(row) * (1.0 - down) + mix(row + 1) * down;
    let value = match texture {
        Texture::Rough => rough,
        Texture::Stripes => 0.5 + 0.4 * (at.x * std::f64::consts::TAU / 0.04).sin(),
        Texture::None => 0.5,
    };
    (255.0 * value) as u8
}

fn wall(from: &Point3<f64>, ray: &Vector3<f64>) -> (f64, Texture) {
    ((WALL_M - from.z) / ray.z, Texture::Rough)
}

fn wall_behind_box(from: &Point3<f64>, ray: &Vector3<f64>) -> (f64, Texture) {
    let to_box = (BOX_M - from.z) / ray.z;
    if from.x + to_box * ray.x < 0.0 {
        (to_box, Texture::Rough)
    } else {
        wall(from, ray)
    }
}

fn stripes(from: &Point3<f64>, ray: &Vector3<f64>) -> (f64, Texture) {
    (wall(from, ray).0, Texture::Stripes)
}

fn plain(from: &Point3<f64>, ray: &Vector3<f64>) -> (f64, Texture) {
    (wall(from, ray).0, Texture::None)
}

/// A picture of the scene from a place, looking along z, rotated about y.
fn picture(scene: Scene, [x, y, z]: [f64; 3], rotation_rad: f64) -> Keyframe {
    let world_from_camera = Transform::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_axis_angle(&Vector3::y_axis(), rotation_rad),
    );
    let principal_px = SIZE_PX.map(|px| f64::from(px) / 2.0);
    let gray = |ix: u32| {
        let px = [ix % SIZE_PX[0], ix / SIZE_PX[0]];
        let [u, v] = [0, 1].map(|axis| (f64::from(px[axis]) + 0.5 - principal_px[axis]) / FOCAL_PX);
        let from = Point3::new(x, y, z);
        let ray = world_from_camera * Vector3::new(u, v, 1.0);
        let (distance, texture) = scene(&from, &ray);
        intensity(texture, &(from + distance * ray))
    };
    let rgba_srgb: Arc<[u8]> = (0..SIZE_PX[0] * SIZE_PX[1])
        .flat_map(|ix| {
            let gray = gray(ix);
            [gray, gray, gray, 255]
        })
        .collect();
    Keyframe {
        size_px: SIZE_PX,
        focal_px: [FOCAL_PX; 2],
        principal_px,
        rgba_srgb,
        depth: None,
        world_from_camera,
        ..scenes::keyframe(0, &[], world_from_camera)
    }
}

/// Pictures around a place.
fn pictures(scene: Scene) -> Vec<Keyframe> {
    let places = [
        [0.06, 0.0, 0.0],
        [-0.05, 0.03, 0.02],
        [0.02, -0.07, -0.01],
        [0.1, 0.04, 0.0],
    ];
    places
        .into_iter()
        .map(|place| picture(scene, place, -0.3 * place[0]))
        .collect()
}

/// Depth of an image, computed with others.
fn depth_from_images(image: &Keyframe, others: &[&Keyframe]) -> Option<DepthMap> {
    StereoImages::new(others.to_vec()).depth_of(image)
}

/// Relative errors of the known depths, and the fraction of pixels that are known.
fn errors(depth: &DepthMap, scene: Scene) -> (Vec<f64>, f64) {
    let [width, height] = depth.size_px;
    let mut errors = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let z = f64::from(depth.depth_m[(y * width + x) as usize]);
            if z > 0.0 {
                let ray: Vector3<f64> = Point3::from(depth.point(x, y, 1.0)).coords;
                let (truth, _) = scene(&Point3::origin(), &ray);
                errors.push((z - truth).abs() / truth);
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    let known_frac = errors.len() as f64 / f64::from(width * height);
    (errors, known_frac)
}

fn depth_of(scene: Scene) -> Option<DepthMap> {
    let others = pictures(scene);
    let others: Vec<&Keyframe> = others.iter().collect();
    depth_from_images(&picture(scene, [0.0; 3], 0.0), &others)
}

#[test]
fn depths_of_textured_surfaces_are_accurate() {
    for scene in [wall as Scene, wall_behind_box] {
        let depth = depth_of(scene).expect("depth");
        let (errors, known_frac) = errors(&depth, scene);
        let [median, most] = [errors[errors.len() / 2], errors[errors.len() * 95 / 100]];
        assert!(known_frac > 0.5, "{known_frac}");
        assert!(median < 0.01 && most < 0.05, "{median}, {most}");
    }
}

#[test]
fn uncertain_depths_are_left_out() {
    assert!(depth_of(plain).is_none(), "no texture");
    // Every 4 cm of a wall at 1 m look alike, so several depths fit.
    let known_frac = depth_of(stripes).map_or(0.0, |depth| errors(&depth, stripes).1);
    assert!(known_frac < 0.05, "{known_frac}");
}

#[test]
fn an_image_needs_others_from_other_places_with_similar_directions() {
    let image = picture(wall, [0.0; 3], 0.0);
    let turned = picture(wall, [0.1, 0.0, 0.0], 1.5);
    assert!(depth_from_images(&image, &[]).is_none());
    assert!(depth_from_images(&image, &[&image, &image]).is_none());
    assert!(depth_from_images(&image, &[&turned]).is_none());
}

#[test]
fn masked_pixels_have_no_depth() {
    let mut image = picture(wall, [0.0; 3], 0.0);
    let left_half = |ix: usize| (ix / 4) % (SIZE_PX[0] as usize) < SIZE_PX[0] as usize / 2;
    image.rgba_srgb = image
        .rgba_srgb
        .iter()
        .enumerate()
        .map(|(ix, value)| {
            if ix % 4 == 3 && left_half(ix) {
                0
            } else {
                *value
            }
        })
        .collect();
    let others = pictures(wall);
    let others: Vec<&Keyframe> = others.iter().collect();
    let depth = depth_from_images(&image, &others).expect("depth");
    let width = depth.size_px[0] as usize;
    let is_known = |ix: &usize| depth.depth_m[*ix] > 0.0;
    let known: Vec<usize> = (0..depth.depth_m.len()).filter(is_known).collect();
    assert!(known.len() > depth.depth_m.len() / 5, "{}", known.len());
    assert!(known.iter().all(|ix| ix % width >= width / 2));
}

#[test]
fn brightness_does_not_matter() {
    let mut image = picture(wall, [0.0; 3], 0.0);
    let darker = |value: &u8| value / 2 + 20;
    image.rgba_srgb = image.rgba_srgb.iter().map(darker).collect();
    let others = pictures(wall);
    let others: Vec<&Keyframe> = others.iter().collect();
    let depth = depth_from_images(&image, &others).expect("depth");
    let (errors, known_frac) = errors(&depth, wall);
    assert!(known_frac > 0.5 && errors[errors.len() / 2] < 0.01);
}
