// density: converts the output of the first network to density per unit of length.

// Upper limit of the logarithm, to keep densities finite.
const MAX_LOG_DENSITY = 12.0;
// This number is added to the network's output. It determines the density of an untrained field.
const LOG_DENSITY_BIAS = 0.0;

fn density_of(log_density: f32) -> f32 {
    return exp(min(log_density + LOG_DENSITY_BIAS, MAX_LOG_DENSITY));
}

// Whether a density is clamped at the maximum.
fn is_log_density_clamped(log_density: f32) -> bool {
    return log_density + LOG_DENSITY_BIAS >= MAX_LOG_DENSITY;
}
