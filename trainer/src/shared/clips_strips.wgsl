// clips: the boxes that cut the splats of the lanes of a subgroup; see `strips`.

#import clipping

// The clip of another lane's splat.
fn shuffled_clip(clip: u32, lane: u32) -> u32 {
    return subgroupShuffle(clip, lane);
}
