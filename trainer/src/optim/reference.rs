//! Plain CPU version of the optimizer in f64.
//!
//! Source: Kingma and Ba 2015, algorithm 1, with both bias corrections. One second moment for
//! several parameters is used as in Zhang et al. 2024 (Adam-mini).

/// Constants of Adam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adam {
    /// Decay of the mean gradient per step.
    pub beta1: f64,
    /// Decay of the mean squared gradient per step.
    pub beta2: f64,
    /// Added to the root mean square, so that a zero gradient leaves the parameter unchanged.
    pub epsilon: f64,
}

impl Default for Adam {
    /// The constants of gsplat. `epsilon` is far below any gradient of a splat.
    fn default() -> Self {
        Self {
            beta1: 0.9,
            beta2: 0.999,
            epsilon: 1e-15,
        }
    }
}

/// Running means of one parameter's gradient. They are zero before the first step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moments {
    /// Mean gradient.
    pub first: f64,
    /// Mean squared gradient.
    pub second: f64,
}

impl Adam {
    /// Takes one step for a parameter at the given `rate`. `step` counts from 1.
    pub fn update(
        &self,
        step: u32,
        rate: f64,
        param: &mut f64,
        gradient: f64,
        moments: &mut Moments,
    ) {
        moments.first = self.beta1 * moments.first + (1.0 - self.beta1) * gradient;
        moments.second = self.beta2 * moments.second + (1.0 - self.beta2) * gradient * gradient;
        // Both means start at zero and grow at different rates. Without the corrections, the size
        // of the first steps would depend on the two decays instead of on `rate`.
        let steps = f64::from(step);
        let first = moments.first / (1.0 - self.beta1.powf(steps));
        let second = moments.second / (1.0 - self.beta2.powf(steps));
        *param -= rate * first / (second.sqrt() + self.epsilon);
    }

    /// Takes one step for several parameters, each at its own rate.
    ///
    /// All slices have the length of `params`.
    pub fn update_all(
        &self,
        step: u32,
        rates: &[f64],
        params: &mut [f64],
        gradients: &[f64],
        moments: &mut [Moments],
    ) {
        assert_eq!(
            [rates.len(), gradients.len(), moments.len()],
            [params.len(); 3],
            "rates, gradients and moments must have the length of the parameters"
        );
        for (ix, param) in params.iter_mut().enumerate() {
            self.update(step, rates[ix], param, gradients[ix], &mut moments[ix]);
        }
    }

    /// Takes one step for parameters that share one running mean of the squared gradient and have
    /// no first moment.
    pub fn update_shared(
        &self,
        step: u32,
        rate: f64,
        params: &mut [f64],
        gradients: &[f64],
        second: &mut f64,
    ) {
        // A single mean for all parameters saves memory. The parameters then move along their
        // gradient instead of along the signs of its components.
        let mean_square = gradients
            .iter()
            .map(|gradient| gradient * gradient)
            .sum::<f64>()
            / gradients.len() as f64;
        *second = self.beta2 * *second + (1.0 - self.beta2) * mean_square;
        let unbiased = *second / (1.0 - self.beta2.powf(f64::from(step)));
        for (param, gradient) in params.iter_mut().zip(gradients) {
            *param -= rate * gradient / (unbiased.sqrt() + self.epsilon);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mismatches::Mismatches;

    #[test]
    fn steps_match_explicit_means() {
        let adam = Adam::default();
        let gradients = [0.3, -0.1, 0.25, 2.0, -1.5, 1e-3];
        let mut param = 1.0;
        let mut moments = Moments::default();
        let mut expected = 1.0;
        let mut mismatches = Mismatches::default();
        for (ix, &gradient) in gradients.iter().enumerate() {
            let step = u32::try_from(ix + 1).expect("a few steps");
            adam.update(step, 0.01, &mut param, gradient, &mut moments);
            // The bias-corrected means are weighted means of all previous gradients, newest first.
            let mean = |beta: f64, power: i32| {
                let weight = |age: usize| beta.powi(i32::try_from(age).expect("a few steps"));
                let sum: f64 = gradients[..=ix]
                    .iter()
                    .rev()
                    .enumerate()
                    .map(|(age, g)| weight(age) * g.powi(power))
                    .sum();
                sum / (0..=ix).map(weight).sum::<f64>()
            };
            expected -= 0.01 * mean(0.9, 1) / mean(0.999, 2).sqrt();
            mismatches.check(format!("step {step}"), param, expected, 1e-14, 0.0);
        }
        mismatches.assert_none();
    }

    #[test]
    fn each_parameter_uses_its_own_rate() {
        // The first step equals the rate for any gradient magnitude. A zero gradient changes
        // nothing.
        let mut params = [1.0, 2.0, 3.0];
        let mut moments = [Moments::default(); 3];
        Adam::default().update_all(
            1,
            &[0.1, 0.02, 0.5],
            &mut params,
            &[1e-6, -40.0, 0.0],
            &mut moments,
        );
        let expected = [0.9, 2.02, 3.0];
        assert!(
            params
                .iter()
                .zip(expected)
                .all(|(got, expected)| (got - expected).abs() < 1e-8),
            "{params:?}"
        );
    }

    #[test]
    fn converges_in_a_narrow_valley() {
        let mut params = [4.0, -3.0];
        let mut moments = [Moments::default(); 2];
        for step in 1..=2000 {
            let gradients = [2.0 * (params[0] - 1.0), 200.0 * (params[1] + 0.5)];
            let rate = 0.05 * 0.997_f64.powf(f64::from(step));
            Adam::default().update_all(step, &[rate; 2], &mut params, &gradients, &mut moments);
        }
        assert!(
            (params[0] - 1.0).abs() < 1e-3 && (params[1] + 0.5).abs() < 1e-3,
            "{params:?}"
        );
    }
}
