// clips: no box cuts any splat. Training, and pictures without a crop box and without erased space, use this variant.

fn clip_of(splat_ix: u32) -> u32 { return 0u; }

fn shuffled_clip(clip: u32, lane: u32) -> u32 { return 0u; }

fn queue_clips(lane: u32, batch: u32, n_queued: u32) {}

fn queued_clip(i: u32) -> u32 { return 0u; }

fn clipped(hit: PxB, clip: u32, dx: Px, dy: f32) -> PxB { return hit; }
