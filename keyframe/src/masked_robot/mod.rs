//! The robot in the view of a camera, from which its mask can be drawn again when the pose or the
//! lens of the camera is corrected.

mod directions;
mod silhouette;

pub use directions::{DIRECTION_STEP_RAD, directions};
pub use silhouette::{Pinhole, Silhouette, Uncertainty};

use kinematics::Transform;
use nalgebra::Point3;
use std::sync::Arc;

/// A convex piece of a robot, given by points, meters.
pub type ConvexPiece = Vec<Point3<f64>>;

/// A robot that is masked in an image, and the pixels that its mask hides.
#[derive(Clone, Debug, PartialEq)]
pub struct MaskedRobot {
    /// The convex pieces of each link, in the frame of the link. All images of a camera share them.
    pub links: Arc<[Vec<ConvexPiece>]>,
    /// How far the robot may be from where it is drawn.
    pub uncertainty: Uncertainty,
    /// Where the links may be while the color image is exposed, in the frame of the color camera.
    pub during_color: Vec<Sweep>,
    /// Where the links may be while the depth image is exposed, in the frame of the color camera.
    /// Empty without depth.
    pub during_depth: Vec<Sweep>,
    /// Pose of the depth camera in the frame of the color camera.
    pub camera_from_depth: Transform,
    /// The pixels that the mask hides.
    pub hidden: HiddenPixels,
}

/// Where a link may be. Each of its pieces may be anywhere in the hull of its points at all poses.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// Index of the link.
    pub link_ix: usize,
    /// Poses of the link in the frame of the color camera.
    pub camera_from_link: Vec<Transform>,
}

/// Pixels that a mask hides, so that they can be shown again.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HiddenPixels {
    /// Runs of color pixels that are valid without the mask: index of the first pixel, row by row,
    /// and number of pixels.
    pub color: Vec<[u32; 2]>,
    /// Runs of depth pixels that have a reading without the mask.
    pub depth: Vec<[u32; 2]>,
    /// The readings of all runs of depth pixels, meters.
    pub depth_m: Vec<f32>,
}

impl MaskedRobot {
    /// The cells of a color image that the robot may cover.
    #[must_use]
    pub fn in_color(&self, view: Pinhole) -> Silhouette {
        self.silhouette(view, &self.during_color, &Transform::identity())
    }

    /// The cells of a depth image that the robot may cover.
    #[must_use]
    pub fn in_depth(&self, view: Pinhole) -> Silhouette {
        self.silhouette(view, &self.during_depth, &self.camera_from_depth.inverse())
    }

    fn silhouette(
        &self,
        view: Pinhole,
        sweeps: &[Sweep],
        view_from_camera: &Transform,
    ) -> Silhouette {
        let mut silhouette = Silhouette::new(view, self.uncertainty);
        for sweep in sweeps {
            let poses: Vec<Transform> = sweep
                .camera_from_link
                .iter()
                .map(|camera_from_link| view_from_camera * camera_from_link)
                .collect();
            for piece in self.links.get(sweep.link_ix).into_iter().flatten() {
                let points = poses.iter().flat_map(|view_from_link| {
                    piece.iter().map(move |point| view_from_link * point)
                });
                silhouette.add(&points.collect::<ConvexPiece>());
            }
        }
        silhouette
    }

    /// The same robot in the frame of a corrected camera. The hidden pixels stay the same.
    ///
    /// * `corrected_from_camera`: pose of the uncorrected camera in the frame of the corrected one.
    /// * `depth_correction`: `camera_from_depth` is multiplied by it from the left.
    #[must_use]
    pub fn seen_by_corrected(
        &self,
        corrected_from_camera: &Transform,
        depth_correction: &Transform,
    ) -> Self {
        let moved = |sweeps: &[Sweep]| -> Vec<Sweep> {
            let moved = sweeps.iter().map(|sweep| Sweep {
                link_ix: sweep.link_ix,
                camera_from_link: sweep
                    .camera_from_link
                    .iter()
                    .map(|camera_from_link| corrected_from_camera * camera_from_link)
                    .collect(),
            });
            moved.collect()
        };
        Self {
            during_color: moved(&self.during_color),
            during_depth: moved(&self.during_depth),
            camera_from_depth: depth_correction * self.camera_from_depth,
            ..self.clone()
        }
    }

    /// The same robot; the hidden depth readings are multiplied by a factor.
    #[must_use]
    pub fn with_depth_scaled(&self, factor: f32) -> Self {
        let mut scaled = self.clone();
        for reading in &mut scaled.hidden.depth_m {
            *reading *= factor;
        }
        scaled
    }

    /// Host memory of the arrays that belong to one image only, bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let HiddenPixels {
            color,
            depth,
            depth_m,
        } = &self.hidden;
        let poses = self.during_color.iter().chain(&self.during_depth);
        let n_poses: usize = poses.map(|sweep| sweep.camera_from_link.len()).sum();
        (n_poses * size_of::<Transform>()
            + size_of_val(&**color)
            + size_of_val(&**depth)
            + size_of_val(&**depth_m)) as u64
    }
}
