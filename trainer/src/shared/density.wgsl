// density: what the first network tells, as density per unit of length.

// The logarithm ends here, so that no density is infinite.
const MOST_LOG_DENSITY = 12.0;
// Added to what the network tells: a field that knows nothing is thin.
const FIRST_LOG_DENSITY = 0.0;

fn density_of(told: f32) -> f32 {
    return exp(min(told + FIRST_LOG_DENSITY, MOST_LOG_DENSITY));
}

// Whether a density would be larger if it could.
fn is_cut_of(told: f32) -> bool {
    return told + FIRST_LOG_DENSITY >= MOST_LOG_DENSITY;
}
