// ray_loss: how the loss of a ray is weighed.

struct RayLoss {
    background_srgb: vec4f,   // behind everything; w unused
    distance_per_m: f32,
    distance_clip_m: f32,     // differences of distance beyond this pull no more
    distortion: f32,
    near_m: f32,              // where the places of the spread begin
}
