//! Tests of the search for floaters among cells. The tests of each method search through models.

use super::{CellLabels, CellMask, Groups};
use model_files::edits::CellGrid;

const GRID: CellGrid = CellGrid {
    center_m: [1.0, 0.0, -2.0],
    radius_m: 0.5,
    n_cells: 40,
};

#[test]
fn mask_holds_the_marked_cells_in_order() {
    let cells = [0, 3, 4, 5, 9, 11];
    let mut mask = CellMask::none(&GRID);
    mask.extend(cells.iter().rev().copied());
    assert!(mask.cells().eq(cells) && mask.contains(11) && !mask.contains(10));
}

#[test]
fn small_groups_of_cells_are_floaters() {
    // The model is a plate of 30 x 30 cells, two cells above the plate, and one cell that touches a
    // corner of the plate.
    let cell = |x: u32, y: u32, z: u32| x + 40 * (y + 40 * z);
    let mut occupied = CellMask::none(&GRID);
    occupied.extend((5..35).flat_map(|x| (5..35).map(move |y| cell(x, y, 10))));
    occupied.extend([cell(4, 4, 11), cell(20, 20, 14)]);
    let labels = CellLabels::of_occupied(&GRID, &occupied, Groups::new(GRID.n()));
    assert_eq!(
        (labels.floating.n_marked(), labels.kept.n_marked()),
        (1, 901)
    );
    let erased = labels.erased(&GRID).unwrap();
    let n_erased: u32 = erased.ranges().iter().map(|[first, end]| end - first).sum();
    assert_eq!(n_erased, 27, "the floater and the cells around it");
    let mut connected = Groups::new(GRID.n());
    connected.join(cell(20, 20, 14), cell(20, 20, 10));
    assert!(
        CellLabels::of_occupied(&GRID, &occupied, connected)
            .erased(&GRID)
            .is_none(),
        "connected by a splat"
    );
    occupied.insert(cell(21, 20, 14));
    let labels = CellLabels::of_occupied(&GRID, &occupied, Groups::new(GRID.n()));
    assert!(labels.erased(&GRID).is_none(), "more than one in 500");
}
