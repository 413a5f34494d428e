//! Tests of edits as data; the tests of each method draw them.

use super::{CellGrid, CellLabels, CellMask, CellSet, Edit, Edits, Groups, MAX_EDITS};
use crate::{Aabb, Error};
use kinematics::Transform;
use nalgebra::Vector3;
use std::collections::BTreeSet;

const GRID: CellGrid = CellGrid { center_m: [1.0, 0.0, -2.0], radius_m: 0.5, n_cells: 40 };

fn rotated_box() -> Aabb {
    let world_from_box = Transform::new(Vector3::new(0.5, -2.0, 1.25), Vector3::new(0.3, -1.1, 0.7));
    Aabb { world_from_box, min_m: [-1.0, 0.0, 0.5], max_m: [1.0, 2.0, 0.75] }
}

#[test]
fn boxes_are_erased_in_their_frame() {
    let aabb = rotated_box();
    let mut edits = Edits::default();
    edits.push(Edit::Box(aabb)).unwrap();
    for (in_box, is_inside) in
        [([0.0, 1.0, 0.6], true), ([0.99, 0.01, 0.51], true), ([0.0, 1.0, 0.8], false), ([-1.01, 1.0, 0.6], false)]
    {
        let in_world = aabb.world_from_box * nalgebra::Point3::from(in_box);
        assert_eq!(edits.erases(in_world.coords.into()), is_inside, "{in_box:?}");
    }
    edits.undo().unwrap();
    assert!(edits.is_empty() && matches!(edits.undo(), Err(Error::NothingToUndo)));
}

#[test]
fn number_of_edits_is_limited() {
    let mut edits = Edits::default();
    for _ in 0..MAX_EDITS {
        edits.push(Edit::Box(rotated_box())).unwrap();
    }
    let error = edits.push(Edit::Box(rotated_box())).unwrap_err();
    assert_eq!((edits.len(), error.to_string().as_str()), (64, "a model has at most 64 edits; undo one first"));
}

#[test]
fn cells_cover_all_space() {
    // Cells inside the radius are 4 r / n = 5 cm wide.
    assert!((GRID.cell_m([1.2, 0.3, -2.0]) - 0.05).abs() < 1e-12);
    assert_eq!(GRID.cell_at([1.01, 0.01, -1.99]), GRID.cell_at([1.04, 0.04, -1.96]));
    assert_ne!(GRID.cell_at([1.01, 0.01, -1.99]), GRID.cell_at([0.99, 0.01, -1.99]));
    let corner = GRID.cell_at([-1e9; 3]);
    assert_eq!((corner, GRID.cell_at([1e9; 3])), (0, 40 * 40 * 40 - 1));
    assert_eq!(GRID.neighbors(corner).collect::<BTreeSet<_>>(), BTreeSet::from([1, 40, 41, 1600, 1601, 1640, 1641]));
    assert_eq!(GRID.neighbors(GRID.cell_at([1.01, 0.01, -1.99])).count(), 26);
    let cells = BTreeSet::from([3, 4, 5, 9, 11, corner]);
    let mut mask = CellMask::none(&GRID);
    mask.extend(cells.iter().rev().copied());
    assert!(mask.cells().eq(cells.iter().copied()) && mask.contains(11) && !mask.contains(10));
    let set = CellSet::new(GRID, cells);
    assert_eq!(set.ranges, [[0, 1], [3, 6], [9, 10], [11, 12]]);
}

#[test]
fn small_groups_of_cells_are_floaters() {
    // A plate of 30 x 30 cells, two cells above it, and one that touches a corner of the plate.
    let cell = |x: u32, y: u32, z: u32| x + 40 * (y + 40 * z);
    let mut occupied = CellMask::none(&GRID);
    occupied.extend((5..35).flat_map(|x| (5..35).map(move |y| cell(x, y, 10))));
    occupied.extend([cell(4, 4, 11), cell(20, 20, 14)]);
    let labels = CellLabels::of_occupied(&GRID, &occupied, Groups::new(GRID.n()));
    assert_eq!((labels.floating.n_marked(), labels.kept.n_marked()), (1, 901));
    let erased = labels.erased(&GRID).unwrap();
    let n_erased: u32 = erased.ranges.iter().map(|[first, end]| end - first).sum();
    assert_eq!(n_erased, 27, "the floater and the cells around it");
    let mut connected = Groups::new(GRID.n());
    connected.join(cell(20, 20, 14), cell(20, 20, 10));
    assert!(CellLabels::of_occupied(&GRID, &occupied, connected).erased(&GRID).is_none(), "connected by a splat");
    occupied.insert(cell(21, 20, 14));
    let labels = CellLabels::of_occupied(&GRID, &occupied, Groups::new(GRID.n()));
    assert!(labels.erased(&GRID).is_none(), "more than one in 500");
}

#[test]
fn files_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    assert!(Edits::read(folder.path()).unwrap().is_empty(), "no file");
    let mut edits = Edits::default();
    let aabb = Aabb { world_from_box: Transform::translation(0.1, 0.2, 0.3), ..rotated_box() };
    edits.push(Edit::Box(aabb)).unwrap();
    edits.push(Edit::Cells(CellSet::new(GRID, [7, 8, 100]))).unwrap();
    edits.write(folder.path()).unwrap();
    assert!(Edits::read(folder.path()).unwrap() == edits);
    Edits::default().write(folder.path()).unwrap();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "no edits, no file");
}

#[test]
fn damaged_files_are_rejected_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let error_of = |edits: &str| {
        std::fs::write(folder.path().join("edits.json"), format!("{{\"edits\": {edits}}}")).unwrap();
        let error = Edits::read(folder.path()).unwrap_err();
        format!("{error}: {}", std::error::Error::source(&error).unwrap())
    };
    let grid = r#""grid": {"center_m": [0, 0, 0], "radius_m": 1, "n_cells": 10}"#;
    let pose = "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]";
    for (edits, named) in [
        ("[", "expected value"),
        (r#"[{"ball": {}}]"#, "ball"),
        (r#"[{"box": {"world_from_box": [0], "min_m": [0, 0, 0], "max_m": [1, 1, 1]}}]"#, "16"),
        (&format!(r#"[{{"box": {{"world_from_box": {pose}, "min_m": [0, 0, 0], "max_m": [1, 0, 1]}}}}]"#), "corners"),
        (&format!(r#"[{{"cells": {{{grid}, "ranges": [[5, 7], [6, 8]]}}}}]"#), "disjoint"),
        (&format!(r#"[{{"cells": {{{grid}, "ranges": [[999, 1001]]}}}}]"#), "1000"),
        (&format!(r#"[{{"cells": {{{grid}, "ranges": []}}}}]"#), "at least one range"),
        (&format!(r#"[{{"cells": {{{}, "ranges": [[0, 1]]}}}}]"#, grid.replace("10}", "4096}")), "invalid grid"),
    ] {
        let error = error_of(edits);
        assert!(error.contains(named) && error.contains("edits.json"), "{edits}: {error}");
    }
    let one = format!(r#"{{"cells": {{{grid}, "ranges": [[0, 1]]}}}}"#);
    assert!(error_of(&format!("[{}]", vec![one; 65].join(","))).contains("at most 64"));
}
