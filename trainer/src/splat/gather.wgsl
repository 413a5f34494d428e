// gather: copy the kept entries from one buffer of the model to another.
//
// threads   one per word of the new buffer's used part, 256 per workgroup
// reads     gathering, kept [n_kept] (indices of entries), from_words
// writes    to_words
// twin      a loop in splat/trainer/model_size.rs (tests)

#import view

struct Gathering {
    n_kept: u32,
    n_planes: u32,
    words: u32,            // per entry
    from_capacity: u32,    // entries between the starts of two planes
    to_capacity: u32,
}

@group(0) @binding(0) var<uniform> gathering: Gathering;
@group(0) @binding(1) var<storage, read> kept: array<u32>;
@group(0) @binding(2) var<storage, read> from_words: array<u32>;
@group(0) @binding(3) var<storage, read_write> to_words: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = folded(wg, n_wgs) * 256u + lane;
    let per_plane = gathering.n_kept * gathering.words;
    if at >= per_plane * gathering.n_planes { return; } // Allowed here: no barrier below.
    let plane = at / per_plane;
    let entry = (at % per_plane) / gathering.words;
    let word = at % gathering.words;
    let from_entry = plane * gathering.from_capacity + kept[entry];
    let to_entry = plane * gathering.to_capacity + entry;
    to_words[to_entry * gathering.words + word] = from_words[from_entry * gathering.words + word];
}
