//! Depth of a keyframe in the view of its color camera.
#![expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "pixels are rounded down on purpose, within image sizes that are u32"
)]

use keyframe::{DepthMap, Keyframe};
use nalgebra::Point3;
use numbers::f32_of;
use numbers::quantile::{Rank, quantile};
use std::sync::Arc;

/// Median of the depth of a keyframe, meters. `None` without depth.
pub(crate) fn median_depth_m(keyframe: &Keyframe) -> Option<f64> {
    let depth = keyframe.depth.as_ref()?;
    // A prime stride samples all columns and rows, because it has no factor in common with the
    // width. Small images use a shorter stride, to get at least 64 samples.
    let step = 997.min(depth.depth_m.len() / 64).max(1);
    let sample = depth
        .depth_m
        .iter()
        .copied()
        .step_by(step)
        .filter(|z| *z > 0.0);
    quantile(
        &mut sample.map(f64::from).collect::<Vec<_>>(),
        0.5,
        Rank::Upper,
    )
}

/// Depth along the color camera's z axis for each of its pixels. The array is empty if the keyframe
/// has no depth.
///
/// Depth from a camera with another lens, pose or time is reprojected point by point. The nearest
/// point wins.
pub(crate) fn depth_in_color_view(keyframe: &Keyframe) -> Arc<[f32]> {
    let Some(depth) = &keyframe.depth else {
        return [].into();
    };
    let same_lens = depth.size_px == keyframe.size_px
        && depth.focal_px == keyframe.focal_px
        && depth.principal_px == keyframe.principal_px;
    if same_lens && depth.world_from_camera == keyframe.world_from_camera {
        return depth.depth_m.clone();
    }
    reprojected(depth, keyframe)
}

/// The readings of `depth` in the pixels of the color camera.
fn reprojected(depth: &DepthMap, keyframe: &Keyframe) -> Arc<[f32]> {
    let color_from_depth = keyframe.world_from_camera.inverse() * depth.world_from_camera;
    let [width, height] = keyframe.size_px;
    let mut reprojected = vec![0.0f32; (width * height) as usize];
    for (ix, z) in depth.depth_m.iter().enumerate().filter(|(_, z)| **z > 0.0) {
        let x = ix as u32 % depth.size_px[0];
        let y = ix as u32 / depth.size_px[0];
        let ray = |pixel: u32, axis: usize| {
            (f64::from(pixel) + 0.5 - depth.principal_px[axis]) / depth.focal_px[axis]
        };
        let z = f64::from(*z);
        let point = color_from_depth * Point3::new(ray(x, 0) * z, ray(y, 1) * z, z);
        let pixel = [0, 1].map(|axis| {
            keyframe.focal_px[axis] * point[axis] / point.z + keyframe.principal_px[axis]
        });
        // Points behind the color camera would be projected upside down. An infinite depth gives
        // NaN, which is in no range.
        let is_visible = point.z > 0.0
            && (0.0..f64::from(width)).contains(&pixel[0])
            && (0.0..f64::from(height)).contains(&pixel[1]);
        if !is_visible {
            continue;
        }
        // A surface in the depth image may be hidden from the color camera by a nearer surface.
        let nearest_m = &mut reprojected[pixel[1] as usize * width as usize + pixel[0] as usize];
        let depth_m = f32_of(point.z);
        if *nearest_m == 0.0 || depth_m < *nearest_m {
            *nearest_m = depth_m;
        }
    }
    reprojected.into()
}

#[cfg(test)]
mod tests {
    use super::depth_in_color_view;
    use keyframe::scenes;
    use kinematics::Transform;
    use nalgebra::Point3;

    #[test]
    fn infinite_depth_is_not_projected() {
        let target = Point3::origin();
        let pose = scenes::look_at(Point3::new(0.0, -2.0, 0.5), target);
        let mut keyframe = scenes::keyframe(0, &[scenes::ball(target)], pose);
        let depth = keyframe.depth.as_mut().expect("the scene has depth");
        // The pose of the depth differs from the pose of the color camera, so that the depth is
        // projected.
        depth.world_from_camera *= Transform::translation(0.01, 0.0, 0.0);
        let n_seen = depth.depth_m.iter().filter(|z| **z > 0.0).count();
        depth.depth_m = depth.depth_m.iter().map(|_| f32::INFINITY).collect();
        let projected = depth_in_color_view(&keyframe);
        assert!(n_seen > 0 && projected.iter().all(|z| *z == 0.0));
    }
}
