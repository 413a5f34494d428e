// clipping: tests the pixels of a lane against the boxes that cut a splat. Import after `pixels` and `rasterize_bindings`.
//
// twin      splat/reference/clip.rs

#import splat_clip
#import space
#import erased

@group(0) @binding(13) var<storage, read> erased: array<vec4u>;
@group(0) @binding(14) var<storage, read> clips: array<Clip>;

const UNCUT = 0xffffffffu;

// Index of the splat if a box cuts it, else UNCUT.
fn clip_of(splat_ix: u32) -> u32 {
    let is_cut = (clips[splat_ix].is_cropped | clips[splat_ix].boxes_low | clips[splat_ix].boxes_high) != 0u;
    return select(UNCUT, splat_ix, is_cut);
}

// One point per pixel.
struct Points {
    x: Px,
    y: Px,
    z: Px,
}

fn along_row(row: vec4f, points: Points) -> Px {
    return row.x * points.x + row.y * points.y + row.z * points.z + row.w;
}

fn is_between(along: Px, low: f32, high: f32) -> PxB {
    return (along >= Px(low)) & (along <= Px(high));
}

fn in_crop(points: Points) -> PxB {
    return is_between(along_row(view.crop_row_0, points), view.crop_min.x, view.crop_max.x)
        & is_between(along_row(view.crop_row_1, points), view.crop_min.y, view.crop_max.y)
        & is_between(along_row(view.crop_row_2, points), view.crop_min.z, view.crop_max.z);
}

fn in_erased_box(group: u32, points: Points) -> PxB {
    let low = min_of_box(group);
    let high = max_of_box(group);
    return is_between(along_row(bitcast<vec4f>(erased[group]), points), low.x, high.x)
        & is_between(along_row(bitcast<vec4f>(erased[group + 1u]), points), low.y, high.y)
        & is_between(along_row(bitcast<vec4f>(erased[group + 2u]), points), low.z, high.z);
}

// The pixels of `hit` at which the splat `clip` is drawn. `dx` and `dy` point from the pixel to the splat.
fn clipped(hit: PxB, clip: u32, dx: Px, dy: f32) -> PxB {
    if clip == UNCUT || !any(hit) { return hit; }
    let cut = clips[clip];
    let points = Points(
        cut.mean.x - cut.along_x.x * dx - cut.along_y.x * dy,
        cut.mean.y - cut.along_x.y * dx - cut.along_y.y * dy,
        cut.mean.z - cut.along_x.z * dx - cut.along_y.z * dy,
    );
    var drawn = hit;
    if cut.is_cropped != 0u { drawn = drawn & in_crop(points); }
    for (var word = 0u; word < 2u; word++) {
        var boxes = select(cut.boxes_low, cut.boxes_high, word == 1u);
        while boxes != 0u {
            drawn = drawn & !in_erased_box(group_of_edit(32u * word + firstTrailingBit(boxes)), points);
            boxes &= boxes - 1u;
        }
    }
    return drawn;
}
