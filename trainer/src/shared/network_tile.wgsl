// network_tile: memory layout of a field's networks while a workgroup processes 32 samples at once.
//
// A row holds one number of all 32 samples, four samples per vec4. All widths are multiples of 16.
//
// twin      nerf/reference/network.rs

override N_FEATURES: u32;          // inputs of the first network
override N_HIDDEN: u32;            // width of all hidden layers, at most 64
override N_COLOR_IN: u32;          // inputs of the second network, at most 64
override N_COLORS: u32;            // red, green, blue, padded with zeros to 4 or 16 rows
override LANES: u32;               // lanes per workgroup

const TILE = 32u;                  // samples per workgroup
const PARTS = 8u;                  // vec4 per row
const STRIDE = 9u;                 // padded by one vec4, so that 8 rows use different memory banks
const N_DENSITY_OUT = 16u;                // outputs of the first network: log density and 15 geometry features
const N_GEOMETRY_FEATURES = 15u;
const N_HARMONICS = 16u;

// Start of each layer's weights, `[outputs, inputs]`, in the vec4f array of all weights. Gradients use the same layout.
fn density_out_weights() -> u32 { return N_FEATURES * N_HIDDEN / 4u; }
fn hidden_1_weights() -> u32 { return density_out_weights() + N_HIDDEN * N_DENSITY_OUT / 4u; }
fn hidden_2_weights() -> u32 { return hidden_1_weights() + N_COLOR_IN * N_HIDDEN / 4u; }
fn color_weights() -> u32 { return hidden_2_weights() + N_HIDDEN * N_HIDDEN / 4u; }
fn n_weight_words() -> u32 { return color_weights() + N_HIDDEN * N_COLORS / 4u; }

// Rows kept for the backward pass: features, hidden layer of the first network, inputs of the second, its two hidden
// layers.
fn hidden_0_row() -> u32 { return N_FEATURES; }
fn color_input_row() -> u32 { return N_FEATURES + N_HIDDEN; }
fn hidden_1_row() -> u32 { return N_FEATURES + N_HIDDEN + N_COLOR_IN; }
fn hidden_2_row() -> u32 { return N_FEATURES + 2u * N_HIDDEN + N_COLOR_IN; }
fn n_activation_rows() -> u32 { return N_FEATURES + 3u * N_HIDDEN + N_COLOR_IN; }

// Rows of gradients with respect to the hidden layer and outputs of the first network, both hidden layers of the
// second, colors, and features.
fn v_density_out_row() -> u32 { return N_HIDDEN; }
fn v_hidden_1_row() -> u32 { return N_HIDDEN + N_DENSITY_OUT; }
fn v_hidden_2_row() -> u32 { return 2u * N_HIDDEN + N_DENSITY_OUT; }
fn v_color_row() -> u32 { return 3u * N_HIDDEN + N_DENSITY_OUT; }
fn v_features_row() -> u32 { return 3u * N_HIDDEN + N_DENSITY_OUT + N_COLORS; }
fn n_gradient_rows() -> u32 { return 3u * N_HIDDEN + N_DENSITY_OUT + N_COLORS + N_FEATURES; }
