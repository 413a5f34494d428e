// segments: nothing is stored, because the picture is only displayed.

fn begin_segments(lane: u32, tile_ix: u32, tile: Tile) {}

fn begin_segment(lane: u32, n_batches: u32, tile_ix: u32, tile: Tile, entry: u32, blend: Blend) {}

fn end_segments(lane: u32, tile_ix: u32, tile: Tile, end: u32) {}
