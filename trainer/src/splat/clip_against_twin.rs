//! Tests of clipping against its f64 twin.

use super::against_twin::{
    KernelFixture, MARGIN, adapter_options, are_unambiguous, arrays_of, camera_of, check_image,
};
use super::clipping::Clipper;
use super::params::Camera;
use super::passes::ViewPasses;
use super::reference::rasterize::{clip_margins_m, threshold_margins_clipped};
use super::reference::{self, Clipping, Splat, View, scene};
use gpu::{GpuOptions, Passes};
use kinematics::Transform;
use model_files::edits::{CellGrid, CellSet, Edit, MAX_EDITS};
use model_files::{Aabb, Edits};
use nalgebra::Vector3;
use std::sync::Arc;

/// Distance from a side of a box, meters, below which f32 and f64 may decide differently. The scene
/// has coordinates of about 1 m.
const MARGIN_M: f64 = 1e-4;

/// A rotated box in the middle of [`scene::small_scene`].
fn middle_box() -> Aabb {
    Aabb {
        world_from_box: Transform::new(
            Vector3::new(0.05, -0.04, 0.03),
            Vector3::new(0.3, -0.2, 0.5),
        ),
        min_m: [-0.22, -0.3, -0.25],
        max_m: [0.3, 0.2, 0.24],
    }
}

/// A box near the middle that overlaps with [`middle_box`] only in part.
fn other_box() -> Aabb {
    Aabb {
        world_from_box: Transform::new(Vector3::new(0.2, 0.2, 0.1), Vector3::new(0.0, 0.0, 0.7)),
        min_m: [-0.2; 3],
        max_m: [0.25; 3],
    }
}

/// A box outside the scene.
fn empty_box(ix: usize) -> Aabb {
    let x = 10.0 + ix as f64;
    Aabb {
        world_from_box: Transform::identity(),
        min_m: [x, 0.0, 0.0],
        max_m: [x + 0.5, 1.0, 1.0],
    }
}

/// The cell of a coarse grid that contains a point.
fn cell_around(point_m: [f64; 3]) -> Edit {
    let grid = CellGrid {
        center_m: [0.0; 3],
        radius_m: 1.0,
        n_cells: 16,
    };
    Edit::Cells(CellSet::new(grid, [grid.cell_at(point_m)]))
}

fn edits_of(edits: impl IntoIterator<Item = Edit>) -> Edits {
    let mut all = Edits::default();
    edits.into_iter().for_each(|edit| all.push(edit).unwrap());
    all
}

fn clippings(splats: &[Splat]) -> Vec<Clipping> {
    // This number of boxes also uses bits of the second word.
    let many = (0..MAX_EDITS - 2).map(|ix| Edit::Box(empty_box(ix)));
    let last = [Edit::Box(other_box()), Edit::Box(middle_box())];
    let boxes = [Edit::Box(middle_box()), Edit::Box(other_box())];
    [
        (Some(middle_box()), Edits::default()),
        (None, edits_of(boxes.clone())),
        (Some(other_box()), edits_of([Edit::Box(middle_box())])),
        (None, edits_of([cell_around(splats[0].mean)])),
        (Some(middle_box()), edits_of(many.chain(last))),
    ]
    .map(|(crop, edits)| Clipping { crop, edits })
    .into()
}

fn check_clipping(options: &GpuOptions) {
    for (view, seed) in [(scene::tilted_view(), 5), (scene::rolling_view(), 6)] {
        let splats = scene::small_scene(seed, 40);
        let whole = reference::render(&view, &splats);
        let fixture = KernelFixture::new(options, &view, &arrays_of(&splats));
        for clipping in clippings(&splats) {
            let expected = reference::render_clipped(&view, &splats, &clipping);
            assert_ne!(expected, whole, "{clipping:?} has an effect");
            check_image(
                &render(&fixture, &view, &clipping),
                &expected,
                &unambiguous_pixels(&view, &splats, &clipping),
            );
        }
    }
}

/// The picture of the kernels.
fn render(fixture: &KernelFixture, view: &View, clipping: &Clipping) -> (Vec<[f32; 4]>, Vec<f32>) {
    let camera = Camera {
        crop: clipping.crop,
        edits: Arc::new(clipping.edits.clone()),
        ..camera_of(view)
    };
    let gpu = &fixture.gpu;
    gpu.write(&fixture.view, 0, bytemuck::bytes_of(&camera.view()));
    let mut clipper = Clipper::new(gpu).unwrap();
    let mut passes = Passes::default();
    let clipping = clipper
        .prepare(gpu, &mut passes, &camera, fixture.splats.capacity)
        .unwrap();
    assert!(clipping.is_some());
    let view_passes = ViewPasses {
        clipping,
        ..fixture.passes()
    };
    fixture.render_passes(&view_passes, passes)
}

fn unambiguous_pixels(view: &View, splats: &[Splat], clipping: &Clipping) -> Vec<bool> {
    let margins = threshold_margins_clipped(view, splats, clipping);
    let clip_margins_m = clip_margins_m(view, splats, clipping);
    are_unambiguous(
        margins
            .into_iter()
            .zip(clip_margins_m)
            .map(|(margin, margin_m)| margin > MARGIN && margin_m > MARGIN_M),
    )
}

#[test]
fn clipped_pictures_match_the_twin() {
    for options in adapter_options() {
        check_clipping(&options);
    }
}

/// The same test with the kernels for GPUs.
mod needs_large_subgroups {
    use gpu::testing::options_with_large_subgroups;

    #[test]
    fn clipped_pictures_match_the_twin() {
        if let Some(options) = options_with_large_subgroups() {
            super::check_clipping(&options);
        }
    }
}

#[test]
fn a_wrong_clipping_is_detected() {
    let view = scene::tilted_view();
    let splats = scene::small_scene(5, 40);
    let fixture = KernelFixture::new(&GpuOptions::default(), &view, &arrays_of(&splats));
    let crop_to = |crop: Aabb| Clipping {
        crop: Some(crop),
        edits: Edits::default(),
    };
    let mut moved = middle_box();
    moved.max_m[0] += 0.05;
    let image = render(&fixture, &view, &crop_to(moved));
    let expected = reference::render_clipped(&view, &splats, &crop_to(middle_box()));
    let unambiguous = unambiguous_pixels(&view, &splats, &crop_to(middle_box()));
    let checked = std::panic::catch_unwind(|| check_image(&image, &expected, &unambiguous));
    assert!(checked.is_err());
}
