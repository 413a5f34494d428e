// density: what the first network tells, as density per unit of length.

// The logarithm ends here, so that no density is infinite.
const MAX_LOG_DENSITY = 12.0;
// Added to what the network tells: a field that knows nothing is thin.
const LOG_DENSITY_BIAS = 0.0;

fn density_of(log_density: f32) -> f32 {
    return exp(min(log_density + LOG_DENSITY_BIAS, MAX_LOG_DENSITY));
}

// Whether a density would be larger if it could.
fn is_log_density_clamped(log_density: f32) -> bool {
    return log_density + LOG_DENSITY_BIAS >= MAX_LOG_DENSITY;
}
