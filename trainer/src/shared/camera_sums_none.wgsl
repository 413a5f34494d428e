// camera_sums: no-op variant, used when no camera parameters are optimized.

fn add_up_camera(lane: u32, block: u32, mine: CameraGradient) {}
