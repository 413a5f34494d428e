// splat_clip: where boxes cut a splat, as `clip` computes it for `rasterize`.
//
// A splat is drawn at a pixel only if its density along the pixel's ray is largest at a point inside the crop box and
// outside all erased boxes. In the linear approximation of the projection, this point is the conditional mean of the
// splat given the pixel, which is linear in the pixel's position.
//
// twin      splat/reference/clip.rs

struct Clip {
    mean: vec3f,       // point at the splat's center, in world, meters
    is_cropped: u32,   // 1 if the crop box cuts the splat
    along_x: vec3f,    // change of the point per pixel to the right
    boxes_low: u32,    // bits of the erased boxes among the first 32 edits that cut the splat
    along_y: vec3f,    // the same per pixel down
    boxes_high: u32,   // bits of the other 32 edits
}
