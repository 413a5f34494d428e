// network_layers: widths of the layers of both networks, the tile rows of their inputs and output gradients, and the
// start of their weights. Import after `network_tile`.

const N_LAYERS = 5u;

struct Layer {
    n_in: u32,
    n_out: u32,
    activation_row: u32,
    v_row: u32,
    first_weight: u32,     // in vec4f
}

fn layer_of(ix: u32) -> Layer {
    switch ix {
        case 0u: { return Layer(N_FEATURES, N_HIDDEN, 0u, 0u, 0u); }
        case 1u: { return Layer(N_HIDDEN, N_DENSITY_OUT, hidden_0_row(), v_density_out_row(), density_out_weights()); }
        case 2u: { return Layer(N_COLOR_IN, N_HIDDEN, color_input_row(), v_hidden_1_row(), hidden_1_weights()); }
        case 3u: { return Layer(N_HIDDEN, N_HIDDEN, hidden_1_row(), v_hidden_2_row(), hidden_2_weights()); }
        default: { return Layer(N_HIDDEN, N_COLORS, hidden_2_row(), v_color_row(), color_weights()); }
    }
}
