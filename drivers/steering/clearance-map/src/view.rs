//! A depth camera in the grid: from pixels to points, and from cubes of voxels to pixels.

use crate::grid::Grid;
use crate::image::DepthImage;
use nalgebra::{Matrix3, Vector2, Vector3};

/// Cubes closer to the plane of the camera than this are too distorted to be judged, meters.
const MIN_DEPTH_M: f32 = 0.01;

/// Pixels around a cube that must also show that it is free. A part of a surface that reaches into
/// the cube by less than the distance of two pixels may be between them, and a pixel may be without
/// a reading.
const PADDING_PX: f32 = 2.0;

/// A pinhole camera in the grid.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View {
    pub(crate) size_px: [usize; 2],
    focal_px: [f32; 2],
    principal_px: [f32; 2],
    /// Position in voxels.
    center: Vector3<f32>,
    /// Columns: axes of the camera, voxels per meter.
    grid_from_camera: Matrix3<f32>,
    /// Rows: axes of the camera, meters per voxel.
    camera_from_grid: Matrix3<f32>,
    /// Half of the extent of a voxel along the axes of the camera, meters.
    half_voxel_m: Vector3<f32>,
}

/// A cube of voxels as the camera sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Projected {
    /// Depth of its center, its closest and its farthest point, meters.
    pub(crate) center_m: f32,
    pub(crate) near_m: f32,
    pub(crate) far_m: f32,
    /// Smallest and largest pixel coordinates of all of its points.
    pub(crate) low_px: [f32; 2],
    pub(crate) high_px: [f32; 2],
}

/// Where a cube of voxels is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Visible {
    /// Behind the camera, or beside the image.
    No,
    /// Partly beside the image or too close to the plane of the camera.
    Partly,
    /// Within the image.
    Whole(Projected),
}

impl View {
    pub(crate) fn new(grid: &Grid, image: &DepthImage) -> Self {
        let pose = &image.world_from_camera;
        let rotation: Matrix3<f64> = *pose.rotation.to_rotation_matrix().matrix();
        let grid_from_camera = rotation / grid.voxel_m;
        let camera_from_grid = rotation.transpose() * grid.voxel_m;
        let half_voxel_m = Vector3::from_fn(|axis, _| 0.5 * camera_from_grid.row(axis).abs().sum());
        let cast = |values: [f64; 2]| Vector2::from(values).cast::<f32>().into();
        Self {
            size_px: image.size_px.map(|size| size as usize),
            focal_px: cast(image.focal_px),
            principal_px: cast(image.principal_px),
            center: grid.in_voxels(&pose.translation.vector).cast(),
            grid_from_camera: grid_from_camera.cast(),
            camera_from_grid: camera_from_grid.cast(),
            half_voxel_m: half_voxel_m.cast(),
        }
    }

    /// Position of the camera, voxels.
    pub(crate) fn center(&self) -> Vector3<f32> {
        self.center
    }

    /// The ray through a place in the image: voxels per meter of depth. The ray through the place one
    /// pixel to the right is this plus [`Self::per_column`].
    pub(crate) fn ray(&self, x_px: f32, y_px: f32) -> Vector3<f32> {
        let slope = |px: f32, axis: usize| (px - self.principal_px[axis]) / self.focal_px[axis];
        self.grid_from_camera * Vector3::new(slope(x_px, 0), slope(y_px, 1), 1.0)
    }

    /// How a ray changes from one column to the next.
    pub(crate) fn per_column(&self) -> Vector3<f32> {
        self.grid_from_camera.column(0) / self.focal_px[0]
    }

    /// Extent of a voxel along z of the camera, meters.
    pub(crate) fn voxel_depth_m(&self) -> f32 {
        2.0 * self.half_voxel_m.z
    }

    /// A cube of voxels in the image.
    pub(crate) fn project(&self, center: &Vector3<f32>, side: usize) -> Visible {
        let in_camera = self.camera_from_grid * (center - self.center);
        let half = self.half_voxel_m * side as f32;
        let near_m = in_camera.z - half.z;
        let far_m = in_camera.z + half.z;
        if far_m < MIN_DEPTH_M {
            return Visible::No;
        }
        if near_m < MIN_DEPTH_M {
            return Visible::Partly;
        }
        let spans_px = [0, 1].map(|axis| self.span_px(axis, &in_camera, &half));
        let spans_and_sizes = || spans_px.iter().zip(self.size_px);
        if spans_and_sizes().any(|([low, high], size)| *high < 0.0 || *low >= size as f32) {
            return Visible::No;
        }
        if spans_and_sizes().any(|([low, high], size)| *low < 0.0 || *high >= size as f32) {
            return Visible::Partly;
        }
        Visible::Whole(Projected {
            center_m: in_camera.z,
            near_m,
            far_m,
            low_px: spans_px.map(|[low, _]| low),
            high_px: spans_px.map(|[_, high]| high),
        })
    }

    /// Smallest and largest coordinate of a cube's pixels, with padding.
    fn span_px(&self, axis: usize, in_camera: &Vector3<f32>, half: &Vector3<f32>) -> [f32; 2] {
        let slope = in_camera[axis] / in_camera.z;
        // For a point of the cube at `x + dx, z + dz`, the slope differs from `x / z` by
        // `(dx - x / z * dz) / (z + dz)`.
        let max_change = (half[axis] + slope.abs() * half.z) / (in_camera.z - half.z);
        let half_px = self.focal_px[axis] * max_change + PADDING_PX;
        let center_px = self.focal_px[axis] * slope + self.principal_px[axis];
        [center_px - half_px, center_px + half_px]
    }
}
