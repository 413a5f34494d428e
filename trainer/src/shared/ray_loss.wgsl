// ray_loss: weights of the loss of a ray; lengths are in units of the scene radius.

struct RayLoss {
    background_srgb: vec4f,   // behind everything; w unused
    distance_weight: f32,     // per unit
    distance_clip: f32,       // differences of distance beyond this have no gradient
    distortion: f32,
    near: f32,                // minimum distance in the distortion loss
    line_of_sight: f32,               // weight of opacity away from the measured depth
    band: f32,                // opacity is allowed within `band + band_frac * distance` of a reading
    band_frac: f32,
    unused: f32,
}
