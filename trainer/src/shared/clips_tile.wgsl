// clips: the boxes that cut the splats of a batch; see `tile_queue`.

#import clipping

var<workgroup> wg_clips: array<u32, BATCH>; // see `clip_of`

// Takes the clips of a batch. Every lane must call it, after `take_batch` and before a barrier.
fn queue_clips(lane: u32, batch: u32, n_queued: u32) {
    if batch + lane < n_queued { wg_clips[lane] = clip_of(entries[wg_queue[batch + lane]].x); }
}

fn queued_clip(i: u32) -> u32 {
    return wg_clips[i];
}
