// pixel_order: order of a picture's pixels in which 32 successive ones are close together, so that their rays meet the
// same cells.

const ORDER_ROWS = 4u;
const ORDER_COLUMNS = 8u;

fn pixel_at(ix: u32, size_px: vec2u) -> vec2u {
    let strip = ix / (ORDER_ROWS * size_px.x);
    let rows = min(ORDER_ROWS, size_px.y - ORDER_ROWS * strip);
    let in_strip = ix - strip * ORDER_ROWS * size_px.x;
    let tile = in_strip / (ORDER_COLUMNS * rows);
    let columns = min(ORDER_COLUMNS, size_px.x - ORDER_COLUMNS * tile);
    let in_tile = in_strip - tile * ORDER_COLUMNS * rows;
    return vec2u(ORDER_COLUMNS * tile + in_tile % columns, ORDER_ROWS * strip + in_tile / columns);
}
