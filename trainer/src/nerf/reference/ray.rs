//! Samples along a ray, what they add up to, and how far that is from what an image shows there. Lengths are in units of the
//! scene's radius.

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

/// What a ray sees.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// Premultiplied.
    pub rgb: [f64; 3],
    /// What is left of the light behind all samples.
    pub transmittance: f64,
    /// Sum of the weights times the distance along the ray.
    pub distance: f64,
    /// Share of each sample in the picture.
    pub weights: Vec<f64>,
}

/// Adds up the samples of a ray, near ones first (Max 1995).
pub fn composite(samples: &[Sample]) -> Seen {
    let mut seen = Seen { rgb: [0.0; 3], transmittance: 1.0, distance: 0.0, weights: Vec::new() };
    for sample in samples {
        let left = (-sample.density * sample.length()).exp();
        let weight = seen.transmittance * (1.0 - left);
        for channel in 0..3 {
            seen.rgb[channel] += weight * sample.rgb[channel];
        }
        seen.distance += weight * sample.middle();
        seen.transmittance *= left;
        seen.weights.push(weight);
    }
    seen
}

/// Slopes of a loss towards what a ray sees.
#[derive(Clone, Debug, PartialEq)]
pub struct Upstream {
    /// Towards the premultiplied color.
    pub rgb: [f64; 3],
    /// Towards what is left of the light.
    pub transmittance: f64,
    /// Towards the distance.
    pub distance: f64,
    /// Towards each weight alone.
    pub weights: Vec<f64>,
}

/// Slopes towards density and color of each sample.
pub fn composite_backward(samples: &[Sample], seen: &Seen, upstream: &Upstream) -> Vec<(f64, [f64; 3])> {
    let worth = |ix: usize| {
        let color: f64 = (0..3).map(|channel| upstream.rgb[channel] * samples[ix].rgb[channel]).sum();
        color + upstream.distance * samples[ix].middle() + upstream.weights[ix]
    };
    // What lies behind a sample loses as much light as the sample takes.
    let mut behind = seen.transmittance * upstream.transmittance;
    let mut slopes = Vec::with_capacity(samples.len());
    for ix in (0..samples.len()).rev() {
        let transmittance_after: f64 = {
            let upto: f64 = samples[..=ix].iter().map(|sample| sample.density * sample.length()).sum();
            (-upto).exp()
        };
        let v_density = samples[ix].length() * (transmittance_after * worth(ix) - behind);
        slopes.push((v_density, upstream.rgb.map(|v| v * seen.weights[ix])));
        behind += seen.weights[ix] * worth(ix);
    }
    slopes.reverse();
    slopes
}

/// How far the weights of a ray are spread, and the slope towards each of them: zero where all light comes from one place.
///
/// Distances count as `near / t`, so that spread far away costs less. Source: Barron et al. 2022, equation 15, summed in one
/// pass as in Sun et al. 2022.
pub fn distortion(samples: &[Sample], weights: &[f64], near: f64) -> (f64, Vec<f64>) {
    let place = |t: f64| 1.0 - near / t.max(near);
    let middles: Vec<f64> =
        samples.iter().map(|sample| 0.5 * (place(sample.span[0]) + place(sample.span[1]))).collect();
    let lengths: Vec<f64> = samples.iter().map(|sample| place(sample.span[1]) - place(sample.span[0])).collect();
    let in_all: (f64, f64) = weights
        .iter()
        .zip(&middles)
        .fold((0.0, 0.0), |sums, (weight, middle)| (sums.0 + weight, sums.1 + weight * middle));
    let (mut before, mut loss) = ((0.0, 0.0), 0.0);
    let mut slopes = Vec::with_capacity(weights.len());
    for ((weight, middle), length) in weights.iter().zip(&middles).zip(&lengths) {
        let after = (in_all.0 - before.0 - weight, in_all.1 - before.1 - weight * middle);
        let apart = middle * before.0 - before.1 + after.1 - middle * after.0;
        loss += weight * apart + weight * weight * length / 3.0;
        slopes.push(2.0 * apart + 2.0 * weight * length / 3.0);
        before = (before.0 + weight, before.1 + weight * middle);
    }
    (loss, slopes)
}

/// What an image shows where a ray ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// 0 to 1.
    pub rgb: [f64; 3],
    /// Distance along the ray; 0 where unknown.
    pub distance: f64,
}

/// How much each part of the loss counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Of the distance, per unit.
    pub distance_weight: f64,
    /// Differences of distance beyond this pull no more.
    pub distance_clip: f64,
    /// Of the spread.
    pub distortion: f64,
    /// Where the places of the spread begin.
    pub near: f64,
    /// Of light that is held back elsewhere than where the depth says.
    pub sight: f64,
    /// So close to a distance, per itself and at least, light may be held back.
    pub band: [f64; 2],
    /// Color behind everything.
    pub background_rgb: [f64; 3],
}

/// Loss of one ray, and its slopes.
///
/// Where the distance is known, light should be held back there and nowhere else (line of sight: Rematas et al. 2022,
/// equations 9 to 12, with a band in place of a bell); glass, which a depth camera looks through, may still hold back some.
pub fn loss(samples: &[Sample], seen: &Seen, target: &Target, weights: &Weights) -> (f64, Upstream) {
    let (spread, v_weights) = distortion(samples, &seen.weights, weights.near);
    let mut upstream = Upstream {
        rgb: [0.0; 3],
        transmittance: 0.0,
        distance: 0.0,
        weights: v_weights.iter().map(|v| weights.distortion * v).collect(),
    };
    let mut loss = weights.distortion * spread;
    for channel in 0..3 {
        let background = weights.background_rgb[channel];
        let miss = seen.rgb[channel] + seen.transmittance * background - target.rgb[channel];
        loss += miss * miss / 3.0;
        upstream.rgb[channel] = 2.0 * miss / 3.0;
        upstream.transmittance += 2.0 * miss / 3.0 * background;
    }
    if target.distance > 0.0 {
        let reach = weights.band[0] * target.distance + weights.band[1];
        let is_close = |sample: &Sample| (sample.middle() - target.distance).abs() <= reach;
        let parts = || samples.iter().zip(&seen.weights);
        let close: f64 = parts().filter(|(sample, _)| is_close(sample)).map(|(_, weight)| weight).sum();
        let off: f64 = parts().filter(|(sample, _)| !is_close(sample)).map(|(_, weight)| weight * weight).sum();
        loss += weights.sight * ((1.0 - close).powi(2) + off);
        for ((sample, weight), v) in parts().zip(&mut upstream.weights) {
            *v += 2.0 * weights.sight * if is_close(sample) { close - 1.0 } else { *weight };
        }
    }
    let miss_far = seen.distance - (1.0 - seen.transmittance) * target.distance;
    if target.distance > 0.0 {
        loss += weights.distance_weight * miss_far.abs().min(weights.distance_clip);
        if miss_far.abs() < weights.distance_clip {
            let v = weights.distance_weight * miss_far.signum();
            upstream.distance = v;
            upstream.transmittance += v * target.distance;
        }
    }
    (loss, upstream)
}
