// ray_loss: weights of the loss of a ray; lengths are in units of the scene radius.

struct RayLoss {
    background_srgb: vec4f,   // behind everything; w unused
    distance_weight: f32,     // per unit
    distance_clip: f32,       // differences of distance beyond this have no gradient
    distortion: f32,
    near: f32,                // near end of the distances compared by the distortion loss
    line_of_sight: f32,               // weight of opacity away from the measured depth
    band: f32,                // opacity this close to a reading is allowed; `band_frac` is added per distance
    band_frac: f32,
    unused: f32,
}
