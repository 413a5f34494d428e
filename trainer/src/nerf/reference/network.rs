//! A small fully connected network without biases. Hidden layers are followed by a `ReLU`, and the
//! last layer is not.

/// Weights of a network.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    /// Number of inputs, width of each hidden layer, and number of outputs.
    pub sizes: Vec<usize>,
    /// Layer by layer, `[outputs, inputs]` each.
    pub weights: Vec<f64>,
}

impl Network {
    /// Number of weights of a network of these sizes.
    pub fn n_weights(sizes: &[usize]) -> usize {
        sizes.windows(2).map(|pair| pair[0] * pair[1]).sum()
    }

    /// Activations of every layer for an input. The input comes first, then the hidden layers after
    /// the `ReLU`, and then the output.
    pub fn forward(&self, input: &[f64]) -> Vec<Vec<f64>> {
        let mut layers = vec![input.to_vec()];
        let mut begin = 0;
        for (ix, pair) in self.sizes.windows(2).enumerate() {
            let n_in = pair[0];
            let n_out = pair[1];
            let before = &layers[ix];
            let weights = self.weights[begin..begin + n_in * n_out].chunks_exact(n_in);
            let sums = weights.map(|row| {
                row.iter()
                    .zip(before)
                    .map(|(weight, x)| weight * x)
                    .sum::<f64>()
            });
            let is_last = ix + 2 == self.sizes.len();
            let layer = sums
                .map(|sum| if is_last { sum } else { sum.max(0.0) })
                .collect();
            layers.push(layer);
            begin += n_in * n_out;
        }
        layers
    }

    /// Backpropagates gradients of the output. Adds the weight gradients to `v_weights`. Returns
    /// the gradient of the input.
    pub fn backward(
        &self,
        layers: &[Vec<f64>],
        upstream: &[f64],
        v_weights: &mut [f64],
    ) -> Vec<f64> {
        let mut v_out = upstream.to_vec();
        let mut end = self.weights.len();
        for (ix, pair) in self.sizes.windows(2).enumerate().rev() {
            let n_in = pair[0];
            let n_out = pair[1];
            let begin = end - n_in * n_out;
            // The stored activation is after the `ReLU`, so it is positive exactly where the
            // gradient passes.
            if ix + 2 < self.sizes.len() {
                for (v, x) in v_out.iter_mut().zip(&layers[ix + 1]) {
                    *v *= f64::from(*x > 0.0);
                }
            }
            let mut v_in = vec![0.0; n_in];
            for (row, v) in v_out.iter().enumerate() {
                for column in 0..n_in {
                    let at = begin + row * n_in + column;
                    v_weights[at] += v * layers[ix][column];
                    v_in[column] += v * self.weights[at];
                }
            }
            v_out = v_in;
            end = begin;
        }
        v_out
    }
}
