// sample: what the networks told about a sample, as the compositing wants it. After `ray_batch` and
// `density`.

struct Sample {
    begin: f32,
    end: f32,
    density: f32,
    transmitted: f32,         // of the light that comes to it
    rgb: vec3f,
    is_clamped: bool,      // whether its density is the largest there is
}

fn sample_at(ix: u32) -> Sample {
    let span = spans[ix];
    let density = density_of(log_density[ix]);
    let rgb = 1.0 / (1.0 + exp(-colors[ix].rgb));
    return Sample(span.begin, span.end, density, exp(-density * (span.end - span.begin)), rgb, is_log_density_clamped(log_density[ix]));
}
