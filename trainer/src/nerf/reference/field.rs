//! Density and color of a point viewed along a direction.

use super::grid::{self, GridShape, N_FEATURES};
use super::network::Network;
use super::space::contract_backward;
use model_files::contraction::contract;
use model_files::spherical_harmonics;

/// Number of geometry features. They are the outputs of the first network after the density, and
/// inputs of the second network.
pub const N_GEOMETRY_FEATURES: usize = 15;
/// Number of basis functions of the direction, which are spherical harmonics up to degree 3.
pub const N_DIRECTION: usize = 16;
/// Upper limit of the logarithm of the density, to keep densities finite. At exp(12) per radius, a
/// ray is opaque after a fraction of a step.
pub const MAX_LOG_DENSITY: f64 = 12.0;

/// Number added to the network's log density. It determines the density of an untrained field.
pub const LOG_DENSITY_BIAS: f64 = 0.0;

/// All parameters of a field.
#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    /// Sizes of the grid.
    pub shape: GridShape,
    /// Entries of the grid.
    pub table: Vec<[f64; N_FEATURES]>,
    /// Maps grid features to log density and geometry features.
    pub density: Network,
    /// Maps direction, geometry features and the image's appearance embedding to color before the
    /// sigmoid.
    pub color: Network,
}

/// Gradient of a loss with respect to the parameters of a field.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldGrad {
    /// Gradient with respect to the entries of the grid.
    pub table: Vec<[f64; N_FEATURES]>,
    /// Gradient with respect to the weights of the first network.
    pub density: Vec<f64>,
    /// Gradient with respect to the weights of the second network.
    pub color: Vec<f64>,
}

impl FieldGrad {
    /// Zeros in the shape of a field.
    pub fn zeros(field: &Field) -> Self {
        Self {
            table: vec![[0.0; N_FEATURES]; field.table.len()],
            density: vec![0.0; field.density.weights.len()],
            color: vec![0.0; field.color.weights.len()],
        }
    }
}

/// Density and color of a point, and the intermediate values.
#[derive(Clone, Debug)]
pub struct Point {
    /// Per unit of length, which is the scene radius.
    pub density: f64,
    /// 0 to 1.
    pub rgb: [f64; 3],
    contracted: [f64; 3],
    density_layers: Vec<Vec<f64>>,
    color_layers: Vec<Vec<f64>>,
}

impl Field {
    /// Layer sizes of the two networks for a hidden width. The first network has one hidden layer,
    /// and the second has two.
    pub fn sizes(shape: &GridShape, width: usize, embedding_dim: usize) -> [Vec<usize>; 2] {
        [
            vec![shape.n_outputs(), width, 1 + N_GEOMETRY_FEATURES],
            vec![
                N_DIRECTION + N_GEOMETRY_FEATURES + embedding_dim,
                width,
                width,
                3,
            ],
        ]
    }

    /// Density and color of a point, in units of the scene radius around its center, viewed along a
    /// direction of length 1, with an appearance embedding.
    pub fn point(&self, at: [f64; 3], direction: [f64; 3], embedding: &[f64]) -> Point {
        let contracted = contract(at);
        let density_layers =
            self.density
                .forward(&grid::interpolate(&self.shape, &self.table, contracted));
        let out = density_layers.last().expect("an output layer");
        let density = (out[0] + LOG_DENSITY_BIAS).min(MAX_LOG_DENSITY).exp();
        let input = [&harmonics(direction)[..], &out[1..], embedding].concat();
        let color_layers = self.color.forward(&input);
        let out = color_layers.last().expect("an output layer");
        let rgb = std::array::from_fn(|channel| 1.0 / (1.0 + (-out[channel]).exp()));
        Point {
            density,
            rgb,
            contracted,
            density_layers,
            color_layers,
        }
    }

    /// Backpropagates gradients of density and color. Adds the parameter gradients to `gradient`.
    /// Returns the gradients of the point and of the appearance embedding.
    pub fn point_backward(
        &self,
        at: [f64; 3],
        point: &Point,
        v_density: f64,
        v_rgb: [f64; 3],
        gradient: &mut FieldGrad,
    ) -> ([f64; 3], Vec<f64>) {
        // Derivative of the sigmoid.
        let v_out: Vec<f64> = point
            .rgb
            .iter()
            .zip(v_rgb)
            .map(|(value, v)| v * value * (1.0 - value))
            .collect();
        let v_input = self
            .color
            .backward(&point.color_layers, &v_out, &mut gradient.color);
        let (v_geometry_features, v_embedding) =
            v_input[N_DIRECTION..].split_at(N_GEOMETRY_FEATURES);
        let log_density = point.density_layers.last().expect("an output layer")[0];
        // The derivative of the exponential is the density itself. A clamped density does not
        // depend on its logarithm.
        let v_log = if log_density + LOG_DENSITY_BIAS < MAX_LOG_DENSITY {
            v_density * point.density
        } else {
            0.0
        };
        let v_out = [&[v_log][..], v_geometry_features].concat();
        let v_found = self
            .density
            .backward(&point.density_layers, &v_out, &mut gradient.density);
        let v_contracted = grid::interpolate_backward(
            &self.shape,
            &self.table,
            point.contracted,
            &v_found,
            &mut gradient.table,
        );
        (contract_backward(at, v_contracted), v_embedding.to_vec())
    }
}

/// Real spherical harmonics up to degree 3 of a direction of length 1, constant term first.
pub fn harmonics(direction: [f64; 3]) -> [f64; N_DIRECTION] {
    spherical_harmonics::basis(&direction.into())
}
