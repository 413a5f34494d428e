// erased: space that an operator has erased. Import after `space` and `erased` of the kernel: an array of vec4u.
//
// The first group of words holds the number of edits. Five groups per edit follow: three rows of a transform, and two
// groups that depend on the kind of edit. For a box, they are its corners, and the last word is 0. For cells, they are
// the number of cells along an axis, the group at which ranges of cells begin, and in the last word their number.
//
// twin      model-files/src/edits/mod.rs

const GROUPS_PER_EDIT = 5u;

fn row_of_edit(group: u32, point: vec4f) -> f32 {
    return dot(bitcast<vec4f>(erased[group]), point);
}

// A range of cells, given by the first cell and the cell after the last one.
fn erased_range(first: u32, ix: u32) -> vec2u {
    let pair = erased[first + ix / 2u];
    return select(pair.xy, pair.zw, (ix & 1u) == 1u);
}

// Whether the cell around a point, in units of the radius, is in one of the ranges, which are in increasing order.
fn is_in_cells(point: vec3f, n_cells: u32, first: u32, n_ranges: u32) -> bool {
    let coord = min(vec3u(contract(point) * f32(n_cells)), vec3u(n_cells - 1u));
    let cell = coord.x + n_cells * (coord.y + n_cells * coord.z);
    var low = 0u;
    var high = n_ranges;
    while low < high {
        let middle = (low + high) / 2u;
        if erased_range(first, middle).y <= cell { low = middle + 1u; } else { high = middle; }
    }
    return low < n_ranges && erased_range(first, low).x <= cell;
}

// First group of words of an edit.
fn group_of_edit(ix: u32) -> u32 {
    return 1u + GROUPS_PER_EDIT * ix;
}

// A point in the frame and units of an edit.
fn point_in_edit(group: u32, at: vec3f) -> vec3f {
    let homogeneous = vec4f(at, 1.0);
    return vec3f(row_of_edit(group, homogeneous), row_of_edit(group + 1u, homogeneous), row_of_edit(group + 2u, homogeneous));
}

fn is_box(group: u32) -> bool {
    return erased[group + 4u].w == 0u;
}

fn min_of_box(group: u32) -> vec3f {
    return bitcast<vec3f>(erased[group + 3u].xyz);
}

fn max_of_box(group: u32) -> vec3f {
    return bitcast<vec3f>(erased[group + 4u].xyz);
}

// Whether an edit of cells erases a point.
fn cells_erase(group: u32, at: vec3f) -> bool {
    let cells = erased[group + 3u];
    return is_in_cells(point_in_edit(group, at), cells.x, cells.w, erased[group + 4u].w);
}

fn is_erased(at: vec3f) -> bool {
    let n_edits = erased[0].x;
    for (var ix = 0u; ix < n_edits; ix++) {
        let group = group_of_edit(ix);
        if is_box(group) {
            let point = point_in_edit(group, at);
            if all(point >= min_of_box(group)) && all(point <= max_of_box(group)) { return true; }
        } else if cells_erase(group, at) {
            return true;
        }
    }
    return false;
}
