// embedding_gradients: gradients of every sample with respect to the appearance embedding of its image, computed from
// the gradients of the hidden layer that receives the embedding.
//
// threads   one per sample
// reads     batch, weights, v_activations [n_tiles, n_gradient_rows, 8]
// writes    v_embeddings [n_samples]
// twin      nerf/reference/field.rs

#import number
#import folded
#import ray_batch
#import network_tile

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> weights: array<vec4f>;
@group(0) @binding(2) var<storage, read> v_activations: array<Four>;
@group(0) @binding(3) var<storage, read_write> v_embeddings: array<vec4f>;

override EMBEDDING_DIM: u32;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let sample = folded(wg, n_wgs) * 64u + lane;
    if sample >= batch.n_samples { return; }
    let first = (sample / TILE * n_gradient_rows() + v_hidden_1_row()) * PARTS + sample % TILE / 4u;
    var gradient = vec4f(0.0);
    for (var row = 0u; row < N_HIDDEN; row++) {
        let v = f32(v_activations[first + row * PARTS][sample % 4u]);
        for (var k = 0u; k < EMBEDDING_DIM; k++) {
            let weight = row * N_COLOR_IN + N_HARMONICS + N_GEOMETRY_FEATURES + k;
            gradient[k] += v * weights[hidden_1_weights() + weight / 4u][weight % 4u];
        }
    }
    v_embeddings[sample] = gradient / gradient_scale(batch.n_rays);
}
