// ray_loss: how the loss of a ray is weighed; lengths in units of the scene's radius.

struct RayLoss {
    background_srgb: vec4f,   // behind everything; w unused
    distance_weight: f32,     // per unit
    distance_clip: f32,       // differences of distance beyond this pull no more
    distortion: f32,
    near: f32,                // where the places of the spread begin
    line_of_sight: f32,               // weight of light held back elsewhere than where the depth says
    band: f32,                // so close to a reading light may be held back; with the next, per distance
    band_frac: f32,
    unused: f32,
}
