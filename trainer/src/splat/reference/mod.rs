//! Plain CPU version of splatting in f64. Tests compare every kernel of `splat` with it.
//!
//! `project` projects each splat onto the image plane, and `rasterize` composites the splats pixel
//! by pixel. Each of the two has a backward function. In pictures, `clip` limits splats to boxes or
//! cuts boxes out of them. [`decide`] makes the discrete decisions once, which are visibility,
//! depth order and the contributors of each pixel. These decisions are kept fixed while gradients
//! are computed.
//!
//! Source: Kerbl et al. 2023 (3D Gaussian splatting) and Ye et al. 2024 (gsplat, appendix on
//! gradients). The rolling shutter and the depth output are additions of fieldrig. Depth is
//! composited like a color.

#[cfg(test)]
pub(crate) mod change;
pub mod clip;
pub mod project;
#[cfg(test)]
pub(crate) mod random;
pub mod rasterize;

#[cfg(test)]
mod published_picture;
#[cfg(test)]
pub mod scene;
#[cfg(test)]
mod tests;

pub use crate::loss::rendered_image::{RenderedImage, Upstream};
pub use clip::Clipping;
use kinematics::Transform;
pub use project::{project, project_backward};
pub use rasterize::{Decisions, decide, decide_clipped};

/// Raw, optimized values of one splat.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Splat {
    /// Center in the world, meters.
    pub mean: [f64; 3],
    /// Natural logarithms of the standard deviations in meters along the splat's own axes.
    pub log_scale: [f64; 3],
    /// Rotation `world_from_splat`. It may have any nonzero length and is normalized on use.
    pub rotation_wxyz: [f64; 4],
    /// Opacity before the sigmoid.
    pub opacity_logit: f64,
    /// `[(degree + 1)^2, 3]` spherical-harmonic coefficients of the color minus one half, constant
    /// term first.
    pub sh: Vec<[f64; 3]>,
}

/// Gradient of a loss with respect to the raw values of one splat, in the shape of the splat.
pub type SplatGrad = Splat;

/// One camera at one time, with its motion during readout.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Pose at the exposure of the middle row.
    pub camera_from_world: Transform,
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels. The center of pixel `(0, 0)` is `(0.5, 0.5)`.
    pub principal_px: [f64; 2],
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Splats nearer than this along z are not drawn, meters.
    pub near_m: f64,
    /// Translation of the camera during the whole readout in its own axes, meters. This is the
    /// linear velocity times the readout time.
    pub linear_m: [f64; 3],
    /// Rotation of the camera during the whole readout in its own axes, radians. This is the
    /// angular velocity times the readout time.
    pub angular_rad: [f64; 3],
    /// Whether opacities are lowered where [`BLUR_PX2`](project::BLUR_PX2) enlarges splats. See
    /// [`SplatArrays::is_antialiased`](model_files::splat::arrays::SplatArrays::is_antialiased).
    /// Gradients do not include this effect.
    pub is_antialiased: bool,
}

impl View {
    /// Number of pixels of the image.
    pub fn n_pixels(&self) -> usize {
        self.size_px.iter().map(|&side| side as usize).product()
    }

    /// Centers of the pixels, row by row.
    pub fn pixel_centers(&self) -> impl Iterator<Item = [f64; 2]> {
        let [width, height] = self.size_px;
        (0..height).flat_map(move |row| {
            (0..width).map(move |column| [f64::from(column) + 0.5, f64::from(row) + 0.5])
        })
    }
}

/// Gradient of a loss with respect to a view.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ViewGrad {
    /// Gradient with respect to a small motion `exp(pose) * camera_from_world`. The translation in
    /// meters comes before the rotation in radians.
    pub pose: [f64; 6],
    /// Gradient with respect to [`View::linear_m`].
    pub linear_m: [f64; 3],
    /// Gradient with respect to [`View::angular_rad`].
    pub angular_rad: [f64; 3],
}

/// A splat on the image plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Projected {
    /// Center, pixels.
    pub mean_px: [f64; 2],
    /// Inverse of the 2D covariance `[[a, b], [b, c]]` as `[a, b, c]`, per square pixel.
    pub conic: [f64; 3],
    /// Opacity at the center, 0 to 1.
    pub opacity: f64,
    /// Color in the direction of the camera, at least 0.
    pub color: [f64; 3],
    /// Depth of the center along the camera's z axis, meters.
    pub depth: f64,
    /// Half width and height of the bounding box around `mean_px`, pixels. The splat contributes
    /// nothing outside of this box.
    pub extent_px: [f64; 2],
}

/// Gradient of a loss with respect to a [`Projected`]. The extent has no gradient.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ProjectedGrad {
    /// Gradient with respect to the center.
    pub mean_px: [f64; 2],
    /// Gradient with respect to the three numbers of the conic. `b` represents both off-diagonal
    /// entries.
    pub conic: [f64; 3],
    /// Gradient with respect to the opacity.
    pub opacity: f64,
    /// Gradient with respect to the color.
    pub color: [f64; 3],
    /// Gradient with respect to the depth.
    pub depth: f64,
}

/// Gradient of a loss with respect to all inputs of a render.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RenderGrad {
    /// Gradient with respect to the raw values of each splat. It is zero for invisible splats.
    pub splats: Vec<SplatGrad>,
    /// Gradient with respect to each projected splat. It is zero for invisible splats.
    pub projected: Vec<ProjectedGrad>,
    /// Gradient with respect to the view.
    pub view: ViewGrad,
}

/// Renders the splats.
pub fn render(view: &View, splats: &[Splat]) -> RenderedImage {
    render_decided(view, splats, &decide(view, splats))
}

/// Renders the part of the splats that is shown.
pub fn render_clipped(view: &View, splats: &[Splat], clipping: &Clipping) -> RenderedImage {
    render_decided(view, splats, &decide_clipped(view, splats, clipping))
}

/// Renders the splats with fixed decisions, as finite differences require.
pub fn render_decided(view: &View, splats: &[Splat], decisions: &Decisions) -> RenderedImage {
    rasterize::composite(view, &project_decided(view, splats, decisions), decisions)
}

/// Gradient of a loss with respect to every splat and the view, given its gradient with respect to
/// the image.
pub fn render_backward(view: &View, splats: &[Splat], upstream: &Upstream) -> RenderGrad {
    let decisions = decide(view, splats);
    let projected = project_decided(view, splats, &decisions);
    let by_projected = rasterize::composite_backward(view, &projected, &decisions, upstream);
    let mut grad = RenderGrad {
        projected: by_projected,
        ..RenderGrad::default()
    };
    for (splat_ix, splat) in splats.iter().enumerate() {
        // An invisible splat has a gradient of zero in the shape of the splat.
        let Some(row_share) = decisions.row_shares[splat_ix] else {
            grad.splats.push(SplatGrad {
                sh: vec![[0.0; 3]; splat.sh.len()],
                ..SplatGrad::default()
            });
            continue;
        };
        let (by_splat, by_view) =
            project_backward(view, splat, row_share, &grad.projected[splat_ix]);
        grad.splats.push(by_splat);
        grad.view.add(&by_view);
    }
    grad
}

fn project_decided(view: &View, splats: &[Splat], decisions: &Decisions) -> Vec<Projected> {
    // Invisible splats keep their position in the list, so that indices remain the indices of the
    // splats.
    let project_one = |(splat, row_share): (&Splat, &Option<f64>)| {
        row_share
            .map(|row_share| project::project_at(view, splat, row_share))
            .unwrap_or_default()
    };
    splats
        .iter()
        .zip(&decisions.row_shares)
        .map(project_one)
        .collect()
}

impl ViewGrad {
    fn add(&mut self, other: &Self) {
        let sum = |to: &mut [f64], from: &[f64]| {
            to.iter_mut().zip(from).for_each(|(to, from)| *to += from)
        };
        sum(&mut self.pose, &other.pose);
        sum(&mut self.linear_m, &other.linear_m);
        sum(&mut self.angular_rad, &other.angular_rad);
    }
}
