//! Tests of edits as data. The tests of each method check how edits are drawn.

use super::{CellGrid, CellSet, Edit, Edits, MAX_EDITS};
use crate::{Aabb, Error};
use kinematics::Transform;
use nalgebra::Vector3;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::Path;

const GRID: CellGrid = CellGrid {
    center_m: [1.0, 0.0, -2.0],
    radius_m: 0.5,
    n_cells: 40,
};

fn rotated_box() -> Aabb {
    let world_from_box =
        Transform::new(Vector3::new(0.5, -2.0, 1.25), Vector3::new(0.3, -1.1, 0.7));
    Aabb {
        world_from_box,
        min_m: [-1.0, 0.0, 0.5],
        max_m: [1.0, 2.0, 0.75],
    }
}

#[test]
fn boxes_are_erased_in_their_frame() {
    let aabb = rotated_box();
    let mut edits = Edits::default();
    edits.push(Edit::Box(aabb)).unwrap();
    for (in_box, is_inside) in [
        ([0.0, 1.0, 0.6], true),
        ([0.99, 0.01, 0.51], true),
        ([0.0, 1.0, 0.8], false),
        ([-1.01, 1.0, 0.6], false),
    ] {
        let in_world = aabb.world_from_box * nalgebra::Point3::from(in_box);
        assert_eq!(
            edits.erases(in_world.coords.into()),
            is_inside,
            "{in_box:?}"
        );
    }
    edits.undo().unwrap();
    assert!(edits.is_empty() && matches!(edits.undo(), Err(Error::NothingToUndo)));
}

#[test]
fn boxes_hide_only_splats_that_they_contain_as_a_whole() {
    let aabb = rotated_box();
    let mut edits = Edits::default();
    edits.push(Edit::Box(aabb)).unwrap();
    let in_world = |vector: [f64; 3]| (aabb.world_from_box * Vector3::from(vector)).into();
    let center = aabb.world_from_box * nalgebra::Point3::new(0.0, 1.0, 0.62);
    for (along_m, is_hidden) in [
        ([0.1, 0.1, 0.1], true),
        ([0.9, 0.1, 0.1], true),
        ([1.1, 0.1, 0.1], false),
        ([0.1, 1.1, 0.1], false),
        ([0.1, 0.1, 0.15], false),
    ] {
        let [x, y, z] = along_m;
        // Half axes in the order of a rotated splat.
        let half_axes = [[0.0, y, 0.0], [0.0, 0.0, z], [x, 0.0, 0.0]].map(in_world);
        assert_eq!(
            edits.hide_splat(center.coords.into(), half_axes),
            is_hidden,
            "{along_m:?}"
        );
    }
    // The half axes are not all along axes of the box. The ellipsoid is a sphere.
    let half_axes = [[0.08, 0.06, 0.0], [-0.06, 0.08, 0.0], [0.0, 0.0, 0.1]].map(in_world);
    assert!(edits.hide_splat(center.coords.into(), half_axes));
    let outside = aabb.world_from_box * nalgebra::Point3::new(1.05, 1.0, 0.62);
    assert!(!edits.hide_splat(outside.coords.into(), half_axes));
}

#[test]
fn undone_edits_are_made_again_until_a_new_edit() {
    let mut edits = Edits::default();
    assert!(matches!(edits.redo(), Err(Error::NothingToRedo)));
    let made = [
        Edit::Box(rotated_box()),
        Edit::Cells(CellSet::new(GRID, [3])),
    ];
    for edit in &made {
        edits.push(edit.clone()).unwrap();
    }
    edits.undo().unwrap();
    edits.undo().unwrap();
    assert!(edits.is_empty() && edits.n_undone() == 2);
    assert_eq!(edits, Edits::default(), "undone edits do not count");
    assert_eq!(serde_json::to_value(&edits).unwrap(), json!([]));
    edits.redo().unwrap();
    assert_eq!(edits.as_slice(), &made[..1]);
    edits.push(made[1].clone()).unwrap();
    assert!(edits.n_undone() == 0 && matches!(edits.redo(), Err(Error::NothingToRedo)));
    edits.undo().unwrap();
    edits.redo().unwrap();
    assert_eq!(edits.as_slice(), &made);
}

#[test]
fn number_of_edits_is_limited() {
    let mut edits = Edits::default();
    for _ in 0..MAX_EDITS {
        edits.push(Edit::Box(rotated_box())).unwrap();
    }
    let error = edits.push(Edit::Box(rotated_box())).unwrap_err();
    assert_eq!(
        (edits.len(), error.to_string().as_str()),
        (64, "a model has at most 64 edits; undo one first")
    );
}

#[test]
fn cells_cover_all_space() {
    // Cells inside the radius are 4 r / n = 5 cm wide.
    assert!((GRID.cell_m([1.2, 0.3, -2.0]) - 0.05).abs() < 1e-12);
    assert_eq!(
        GRID.cell_at([1.01, 0.01, -1.99]),
        GRID.cell_at([1.04, 0.04, -1.96])
    );
    assert_ne!(
        GRID.cell_at([1.01, 0.01, -1.99]),
        GRID.cell_at([0.99, 0.01, -1.99])
    );
    let corner = GRID.cell_at([-1e9; 3]);
    assert_eq!((corner, GRID.cell_at([1e9; 3])), (0, 40 * 40 * 40 - 1));
    assert_eq!(
        GRID.neighbors(corner).collect::<BTreeSet<_>>(),
        BTreeSet::from([1, 40, 41, 1600, 1601, 1640, 1641])
    );
    assert_eq!(
        GRID.neighbors(GRID.cell_at([1.01, 0.01, -1.99])).count(),
        26
    );
    let set = CellSet::new(GRID, BTreeSet::from([3, 4, 5, 9, 11, corner]));
    assert_eq!(set.ranges, [[0, 1], [3, 6], [9, 10], [11, 12]]);
}

#[test]
fn files_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    assert!(Edits::read(folder.path()).unwrap().is_empty(), "no file");
    let mut edits = Edits::default();
    let aabb = Aabb {
        world_from_box: Transform::translation(0.1, 0.2, 0.3),
        ..rotated_box()
    };
    edits.push(Edit::Box(aabb)).unwrap();
    edits
        .push(Edit::Cells(CellSet::new(GRID, [7, 8, 100])))
        .unwrap();
    edits.write(folder.path()).unwrap();
    assert!(Edits::read(folder.path()).unwrap() == edits);
    Edits::default().write(folder.path()).unwrap();
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        0,
        "no edits, no file"
    );
}

#[test]
fn damaged_files_are_rejected_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let error_of = |edits: &str| {
        std::fs::write(
            folder.path().join("edits.json"),
            format!("{{\"edits\": {edits}}}"),
        )
        .unwrap();
        let error = Edits::read(folder.path()).unwrap_err();
        format!("{error}: {}", std::error::Error::source(&error).unwrap())
    };
    let grid = r#""grid": {"center_m": [0, 0, 0], "radius_m": 1, "n_cells": 10}"#;
    let pose = "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]";
    for (edits, named) in [
        ("[", "expected value"),
        (r#"[{"ball": {}}]"#, "ball"),
        (
            r#"[{"box": {"world_from_box": [0], "min_m": [0, 0, 0], "max_m": [1, 1, 1]}}]"#,
            "16",
        ),
        (
            &format!(
                r#"[{{"box": {{"world_from_box": {pose}, "min_m": [0, 0, 0], "max_m": [1, 0, 1]}}}}]"#
            ),
            "corners",
        ),
        (
            &format!(r#"[{{"cells": {{{grid}, "ranges": [[5, 7], [6, 8]]}}}}]"#),
            "disjoint",
        ),
        (
            &format!(r#"[{{"cells": {{{grid}, "ranges": [[999, 1001]]}}}}]"#),
            "1000",
        ),
        (
            &format!(r#"[{{"cells": {{{grid}, "ranges": []}}}}]"#),
            "at least one range",
        ),
        (
            &format!(
                r#"[{{"cells": {{{}, "ranges": [[0, 1]]}}}}]"#,
                grid.replace("10}", "4096}")
            ),
            "invalid grid",
        ),
    ] {
        let error = error_of(edits);
        assert!(
            error.contains(named) && error.contains("edits.json"),
            "{edits}: {error}"
        );
    }
    let one = format!(r#"{{"cells": {{{grid}, "ranges": [[0, 1]]}}}}"#);
    assert!(error_of(&format!("[{}]", vec![one; 65].join(","))).contains("at most 64"));
}

/// A file with a box and a set of cells.
fn valid_file() -> Value {
    let world_from_box = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
    let grid = json!({"center_m": [10, 0, 0], "radius_m": 1, "n_cells": 10});
    json!({"edits": [
        {"box": {"world_from_box": world_from_box, "min_m": [0, 0, 0], "max_m": [1, 1, 1]}},
        {"cells": {"grid": grid, "ranges": [[0, 1]]}},
    ]})
}

/// Reads a file with these contents. The error includes its cause.
fn read(folder: &Path, file: &Value) -> Result<Edits, String> {
    std::fs::write(folder.join("edits.json"), file.to_string()).unwrap();
    Edits::read(folder)
        .map_err(|error| format!("{error}: {}", std::error::Error::source(&error).unwrap()))
}

/// Which points of a lattice are erased, near the edits of [`valid_file`] and far away.
fn erased(edits: &Edits) -> Vec<bool> {
    const ALONG_M: [f64; 11] = [
        -1e4, -100.0, -20.0, -5.0, -1.0, 0.5, 1.5, 3.0, 9.5, 12.0, 50.0,
    ];
    let points = ALONG_M.into_iter().flat_map(|x| {
        ALONG_M
            .into_iter()
            .flat_map(move |y| ALONG_M.map(|z| [x, y, z]))
    });
    points.map(|point_m| edits.erases(point_m)).collect()
}

/// A field of the table in docs/reference/files.md, a valid value, and invalid values with words
/// that the errors contain.
type Case = (&'static str, Value, Vec<(Value, &'static str)>);

fn cases() -> [Case; 8] {
    let at = |x: f64| json!([1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
    let scaled = json!([2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]);
    let one = valid_file()["edits"][0].clone();
    [
        (
            "edits",
            json!([one]),
            vec![
                (vec![one; 65].into(), "at most 64"),
                (json!({}), "invalid type"),
            ],
        ),
        (
            "box.world_from_box",
            at(-2.0),
            vec![
                (scaled, "not rigid"),
                (at(1e10), "1e9 m"),
                (json!([1]), "16"),
            ],
        ),
        (
            "box.min_m",
            json!([-2, -2, -2]),
            vec![
                (json!([1, 0, 0]), "corners"),
                (json!([-1e300, 0, 0]), "1e9 m"),
            ],
        ),
        (
            "box.max_m",
            json!([4, 4, 4]),
            vec![
                (json!([-1, 1, 1]), "corners"),
                (json!([1, 1, 1.1e9]), "1e9 m"),
            ],
        ),
        (
            "cells.grid.center_m",
            json!([60, 0, 0]),
            vec![(json!([0, -1e10, 0]), "1e9 m"), (json!([0, 0]), "3")],
        ),
        (
            "cells.grid.radius_m",
            json!(60),
            [0.0, -1.0, 1e-7, 1e10]
                .map(|radius_m| (json!(radius_m), "a radius from 1e-6 m to 1e9 m"))
                .to_vec(),
        ),
        (
            "cells.grid.n_cells",
            json!(5),
            vec![
                (json!(0), "1 to 1024"),
                (json!(1025), "1 to 1024"),
                (json!(-1), "u32"),
                (json!(2.5), "u32"),
            ],
        ),
        (
            "cells.ranges",
            json!([[0, 1000]]),
            vec![
                (json!([]), "at least one range"),
                (json!([[5, 5]]), "increasing"),
                (json!([[5, 7], [6, 8]]), "disjoint"),
                (json!([[0, 1001]]), "up to 1000"),
                (json!([[0]]), "2"),
            ],
        ),
    ]
}

/// Changes one field at a time.
#[test]
fn every_documented_field_is_used_and_other_values_are_refused() {
    let page = include_str!("../../../../docs/reference/files.md");
    let section = page
        .split("### `edits.json`")
        .nth(1)
        .and_then(|rest| rest.split("\n##").next())
        .unwrap();
    let rows = section
        .lines()
        .filter_map(|line| line.strip_prefix("| `")?.split('`').next());
    assert_eq!(
        rows.collect::<Vec<_>>(),
        cases().each_ref().map(|(field, ..)| *field)
    );
    let folder = tempfile::tempdir().unwrap();
    let unchanged = erased(&read(folder.path(), &valid_file()).unwrap());
    for (field, valid, invalid) in cases() {
        let kind = usize::from(field.starts_with("cells"));
        let pointer = if field == "edits" {
            "/edits".to_owned()
        } else {
            format!("/edits/{kind}/{}", field.replace('.', "/"))
        };
        let with = |value: &Value| {
            let mut file = valid_file();
            *file.pointer_mut(&pointer).unwrap() = value.clone();
            read(folder.path(), &file)
        };
        assert_ne!(erased(&with(&valid).unwrap()), unchanged, "{field}");
        for (value, words) in invalid
            .iter()
            .chain(&[(Value::Null, "null"), ("1".into(), "string")])
        {
            let error = with(value).unwrap_err();
            assert!(
                error.contains(words) && error.contains("edits.json"),
                "{field} is {value}: {error}"
            );
        }
        let mut without = valid_file();
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        without
            .pointer_mut(parent)
            .unwrap()
            .as_object_mut()
            .unwrap()
            .remove(key)
            .unwrap();
        let error = read(folder.path(), &without).unwrap_err();
        assert!(
            error.contains(&format!("missing field `{key}`")),
            "{field}: {error}"
        );
        let mut with_more = valid_file();
        with_more.pointer_mut(parent).unwrap()["color"] = 1.into();
        let error = read(folder.path(), &with_more).unwrap_err();
        assert!(
            error.contains("unknown field `color`"),
            "beside {field}: {error}"
        );
    }
    let mut both = valid_file();
    both["edits"][0]["cells"] = both["edits"][1]["cells"].clone();
    assert!(read(folder.path(), &both).is_err(), "two kinds in one edit");
}

#[test]
fn boxes_that_cannot_be_stored_are_not_added() {
    let mut edits = Edits::default();
    for (min_m, max_m) in [
        ([-1e300; 3], [1e300; 3]),
        ([0.0; 3], [0.0; 3]),
        ([f64::NAN; 3], [1.0; 3]),
    ] {
        let error = edits
            .push(Edit::Box(Aabb {
                min_m,
                max_m,
                ..rotated_box()
            }))
            .unwrap_err()
            .to_string();
        assert!(error.starts_with("invalid edit: an erased box "), "{error}");
    }
    assert!(edits.is_empty());
}

/// If an unreadable file counted as absent, erased parts would return unnoticed.
#[test]
fn only_an_absent_file_means_no_edits() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("scene.ply"), "ply").unwrap();
    assert!(
        Edits::read(&at("scene.ply")).unwrap().is_empty(),
        "a single file has no edits"
    );
    assert!(Edits::read(&at("gone")).unwrap().is_empty());
    std::fs::write(at("edits.json"), format!("\u{FEFF}{}", valid_file())).unwrap();
    assert_eq!(
        Edits::read(folder.path()).unwrap().len(),
        2,
        "with a byte order mark"
    );
    std::fs::remove_file(at("edits.json")).unwrap();
    std::os::unix::fs::symlink(at("gone"), at("edits.json")).unwrap();
    assert!(
        Edits::read(folder.path())
            .unwrap_err()
            .to_string()
            .contains("edits.json"),
        "a broken link"
    );
    std::fs::remove_file(at("edits.json")).unwrap();
    std::fs::create_dir(at("edits.json")).unwrap();
    assert!(
        Edits::read(folder.path())
            .unwrap_err()
            .to_string()
            .contains("edits.json"),
        "a folder"
    );
}
