//! Compositing of samples along a ray, and the loss of the composited color and distance. Lengths
//! are in units of the scene radius.

/// One sample of a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Begin and end along the ray.
    pub span: [f64; 2],
    /// Per unit of length.
    pub density: f64,
    /// 0 to 1.
    pub rgb: [f64; 3],
}

impl Sample {
    fn length(&self) -> f64 {
        self.span[1] - self.span[0]
    }

    fn middle(&self) -> f64 {
        0.5 * (self.span[0] + self.span[1])
    }
}

/// Composited color and depth of a ray.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedRay {
    /// Premultiplied.
    pub rgb: [f64; 3],
    /// Fraction of light from behind that passes all samples.
    pub transmittance: f64,
    /// Sum of the weights times the distance along the ray.
    pub distance: f64,
    /// Weight of each sample in the composited color.
    pub weights: Vec<f64>,
}

/// Composites the samples of a ray from front to back (Max 1995).
pub fn composite(samples: &[Sample]) -> RenderedRay {
    let mut rendered = RenderedRay {
        rgb: [0.0; 3],
        transmittance: 1.0,
        distance: 0.0,
        weights: Vec::new(),
    };
    for sample in samples {
        let transmitted = (-sample.density * sample.length()).exp();
        let weight = rendered.transmittance * (1.0 - transmitted);
        for channel in 0..3 {
            rendered.rgb[channel] += weight * sample.rgb[channel];
        }
        rendered.distance += weight * sample.middle();
        rendered.transmittance *= transmitted;
        rendered.weights.push(weight);
    }
    rendered
}

/// Gradients of a loss with respect to the outputs of compositing.
#[derive(Clone, Debug, PartialEq)]
pub struct Upstream {
    /// Gradient with respect to the premultiplied color.
    pub rgb: [f64; 3],
    /// Gradient with respect to the transmittance.
    pub transmittance: f64,
    /// Gradient with respect to the distance.
    pub distance: f64,
    /// Gradient with respect to each weight directly.
    pub weights: Vec<f64>,
}

/// Gradients with respect to density and color of each sample.
pub fn composite_backward(
    samples: &[Sample],
    rendered: &RenderedRay,
    upstream: &Upstream,
) -> Vec<(f64, [f64; 3])> {
    let v_weight = |ix: usize| weight_gradient(&samples[ix], upstream, ix);
    // A sample occludes all samples behind it.
    let mut behind = rendered.transmittance * upstream.transmittance;
    let mut gradients = Vec::with_capacity(samples.len());
    for ix in (0..samples.len()).rev() {
        let optical_depth: f64 = samples[..=ix]
            .iter()
            .map(|sample| sample.density * sample.length())
            .sum();
        let transmittance_after = (-optical_depth).exp();
        // A higher density increases the weight of this sample and decreases the weights of all
        // samples behind it.
        let v_density = samples[ix].length() * (transmittance_after * v_weight(ix) - behind);
        gradients.push((v_density, upstream.rgb.map(|v| v * rendered.weights[ix])));
        behind += rendered.weights[ix] * v_weight(ix);
    }
    gradients.reverse();
    gradients
}

/// Gradient with respect to the weight of a sample. It has three parts: a part through the color, a
/// part through the distance, and a direct part.
fn weight_gradient(sample: &Sample, upstream: &Upstream, ix: usize) -> f64 {
    let color: f64 = (0..3)
        .map(|channel| upstream.rgb[channel] * sample.rgb[channel])
        .sum();
    color + upstream.distance * sample.middle() + upstream.weights[ix]
}

/// Distortion loss, which is the spread of the weights along a ray. Also returns its gradient with
/// respect to each weight. The loss is zero if all weight is at one position.
///
/// Distances are normalized to `1 - near / t`, so that spread at large distances has a smaller
/// loss. Source: Barron et al. 2022, equation 15, summed in one pass as in Sun et al. 2022.
pub fn distortion(samples: &[Sample], weights: &[f64], near: f64) -> (f64, Vec<f64>) {
    let normalized_distance = |t: f64| 1.0 - near / t.max(near);
    let middles: Vec<f64> = samples
        .iter()
        .map(|sample| {
            0.5 * (normalized_distance(sample.span[0]) + normalized_distance(sample.span[1]))
        })
        .collect();
    let lengths: Vec<f64> = samples
        .iter()
        .map(|sample| normalized_distance(sample.span[1]) - normalized_distance(sample.span[0]))
        .collect();
    let total: (f64, f64) = weights
        .iter()
        .zip(&middles)
        .fold((0.0, 0.0), |sums, (weight, middle)| {
            (sums.0 + weight, sums.1 + weight * middle)
        });
    // Sums of weights, and of weights times positions, of all samples before and after the current
    // one. They replace the double sum of the equation: |a - b| is a - b for samples before, and b
    // - a for those after.
    let mut before = (0.0, 0.0);
    let mut loss = 0.0;
    let mut gradients = Vec::with_capacity(weights.len());
    for ((weight, middle), length) in weights.iter().zip(&middles).zip(&lengths) {
        let after = (
            total.0 - before.0 - weight,
            total.1 - before.1 - weight * middle,
        );
        let separation = middle * before.0 - before.1 + after.1 - middle * after.0;
        loss += weight * separation + weight * weight * length / 3.0;
        gradients.push(2.0 * separation + 2.0 * weight * length / 3.0);
        before = (before.0 + weight, before.1 + weight * middle);
    }
    (loss, gradients)
}

/// Observed color and distance of a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// 0 to 1.
    pub rgb: [f64; 3],
    /// Distance along the ray. It is 0 where unknown.
    pub distance: f64,
}

/// Weights of the parts of the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Weight of the distance, per unit.
    pub distance_weight: f64,
    /// Distance residuals beyond this have no gradient.
    pub distance_clip: f64,
    /// Weight of the distortion.
    pub distortion: f64,
    /// Minimum distance in the distortion loss.
    pub near: f64,
    /// Weight of the line-of-sight loss, which penalizes opacity away from the measured depth.
    pub line_of_sight: f64,
    /// Half the width of the band around the measured distance in which opacity is allowed. It is
    /// given as a fraction of the distance and an offset.
    pub band: [f64; 2],
    /// Color behind everything.
    pub background_rgb: [f64; 3],
}

/// Loss of one ray, and its gradients.
///
/// If the distance is known, opacity is rewarded there and penalized elsewhere (line of sight:
/// Rematas et al. 2022, equations 9 to 12, with a band instead of a bell curve). Some opacity
/// elsewhere remains possible, for example for glass, which depth cameras do not measure.
pub fn loss(
    samples: &[Sample],
    rendered: &RenderedRay,
    target: &Target,
    weights: &Weights,
) -> (f64, Upstream) {
    let (distortion_loss, v_weights) = distortion(samples, &rendered.weights, weights.near);
    let mut upstream = Upstream {
        rgb: [0.0; 3],
        transmittance: 0.0,
        distance: 0.0,
        weights: v_weights.iter().map(|v| weights.distortion * v).collect(),
    };
    let mut loss = weights.distortion * distortion_loss;
    for channel in 0..3 {
        let background = weights.background_rgb[channel];
        let residual =
            rendered.rgb[channel] + rendered.transmittance * background - target.rgb[channel];
        loss += residual * residual / 3.0;
        upstream.rgb[channel] = 2.0 * residual / 3.0;
        upstream.transmittance += 2.0 * residual / 3.0 * background;
    }
    if target.distance > 0.0 {
        let half_width = weights.band[0] * target.distance + weights.band[1];
        let is_near_reading =
            |sample: &Sample| (sample.middle() - target.distance).abs() <= half_width;
        let parts = || samples.iter().zip(&rendered.weights);
        let near_weight: f64 = parts()
            .filter(|(sample, _)| is_near_reading(sample))
            .map(|(_, weight)| weight)
            .sum();
        let elsewhere_weight_sq: f64 = parts()
            .filter(|(sample, _)| !is_near_reading(sample))
            .map(|(_, weight)| weight * weight)
            .sum();
        loss += weights.line_of_sight * ((1.0 - near_weight).powi(2) + elsewhere_weight_sq);
        for ((sample, weight), v) in parts().zip(&mut upstream.weights) {
            *v += 2.0
                * weights.line_of_sight
                * if is_near_reading(sample) {
                    near_weight - 1.0
                } else {
                    *weight
                };
        }
    }
    let distance_residual = rendered.distance - (1.0 - rendered.transmittance) * target.distance;
    if target.distance > 0.0 {
        loss += weights.distance_weight * distance_residual.abs().min(weights.distance_clip);
        if distance_residual.abs() < weights.distance_clip {
            let v = weights.distance_weight * distance_residual.signum();
            upstream.distance = v;
            upstream.transmittance += v * target.distance;
        }
    }
    (loss, upstream)
}
