// ssim_bindings: bindings and code shared by both variants of `ssim`.

#import view
#import supervision
#import status

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> supervision: Supervision;
@group(0) @binding(2) var<storage, read> status: array<u32>;
@group(0) @binding(3) var<storage, read> image: array<vec4f>;
@group(0) @binding(4) var<storage, read> target_image: array<u32>;
@group(0) @binding(5) var<storage, read_write> ssim_gradients: array<f32>;
@group(0) @binding(6) var<storage, read> gains: vec4f;

struct SimilarityGradients {
    of_mean: Value,
    of_square: Value,
    of_product: Value,
}

// Gradients of the similarity with respect to E[x], E[x x] and E[x y], from the means over a window of picture x and
// keyframe y.
fn similarity_gradients(x: Value, y: Value, xx: Value, yy: Value, xy: Value) -> SimilarityGradients {
    const C1 = 0.0001;
    const C2 = 0.0009;
    let a1 = 2.0 * x * y + C1;
    let a2 = 2.0 * (xy - x * y) + C2;
    let b1 = x * x + y * y + C1;
    let b2 = (xx - x * x) + (yy - y * y) + C2;
    let similarity = a1 * a2 / (b1 * b2);
    let of_product = 2.0 * a1 / (b1 * b2);
    let of_square = -similarity / b2;
    let of_mean = 2.0 * y * a2 / (b1 * b2) - similarity * 2.0 * x / b1 - of_product * y - 2.0 * of_square * x;
    return SimilarityGradients(of_mean, of_square, of_product);
}
