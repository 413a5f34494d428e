// sample: the networks' outputs for a sample, converted for compositing. Import after `ray_batch` and `density`.

struct Sample {
    begin: f32,
    end: f32,
    density: f32,
    transmitted: f32,         // fraction of incoming light that passes through
    rgb: vec3f,
    is_clamped: bool,      // whether the density is at the maximum
}

fn sample_at(ix: u32) -> Sample {
    let span = spans[ix];
    let density = density_of(log_density[ix]);
    let rgb = 1.0 / (1.0 + exp(-colors[ix].rgb));
    return Sample(span.begin, span.end, density, exp(-density * (span.end - span.begin)), rgb, is_log_density_clamped(log_density[ix]));
}
