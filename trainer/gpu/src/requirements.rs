//! Optional features beyond the WebGPU defaults, and their fallbacks.

use crate::GpuOptions;

/// Optional features of the adapter. Each feature has a fallback.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Optional {
    /// Smallest number of lanes per subgroup, 4 to 128. `None` if subgroup operations may not be
    /// used.
    ///
    /// Without subgroups, sorting ranks keys sequentially, and the backward pass sums over lanes in
    /// workgroup memory.
    pub subgroup_lanes: Option<u32>,
    /// GPU timestamps for the time of each pass. Without timestamps, only wall time is available.
    pub timestamps: bool,
    /// Subgroup products of 16x16 f16 matrices, summed in f32. Without these products, neural
    /// fields use f32.
    pub half_matrices: bool,
}

/// Features needed by kernels with f16 matrices.
const HALF_MATRICES: wgpu::Features =
    wgpu::Features::EXPERIMENTAL_COOPERATIVE_MATRIX.union(wgpu::Features::SHADER_F16);

/// Whether the adapter multiplies matrices of the size and types that fieldrig's kernels use.
fn has_half_matrices(adapter: &wgpu::Adapter) -> bool {
    adapter
        .cooperative_matrix_properties()
        .iter()
        .any(|properties| {
            [properties.m_size, properties.n_size, properties.k_size] == [16; 3]
                && properties.ab_type == wgpu::CooperativeScalarType::F16
                && properties.cr_type == wgpu::CooperativeScalarType::F32
        })
}

impl Optional {
    /// Features of `adapter` that `options` allows. With `FIELDRIG_GPU_FEATURES=none`, the caller
    /// allows no features.
    pub(super) fn of(adapter: &wgpu::Adapter, options: &GpuOptions) -> Self {
        let allowed = options.optional_features;
        let features = adapter.features();
        let info = adapter.get_info();
        // Kernels compute the position of a lane from the size of a subgroup, so the size must not
        // vary. Subgroups of fewer than 4 lanes would save no work.
        let same_size = info.subgroup_min_size == info.subgroup_max_size;
        let subgroups =
            features.contains(wgpu::Features::SUBGROUP) && same_size && info.subgroup_min_size >= 4;
        Self {
            subgroup_lanes: (allowed && subgroups).then_some(info.subgroup_min_size),
            timestamps: allowed && features.contains(wgpu::Features::TIMESTAMP_QUERY),
            half_matrices: allowed
                && options.matrices
                // A whole subgroup multiplies each matrix.
                && subgroups
                && features.contains(HALF_MATRICES)
                && has_half_matrices(adapter),
        }
    }

    /// The wgpu features to request.
    pub(super) fn features(self) -> wgpu::Features {
        let mut features = wgpu::Features::empty();
        features.set(wgpu::Features::SUBGROUP, self.subgroup_lanes.is_some());
        features.set(wgpu::Features::TIMESTAMP_QUERY, self.timestamps);
        features.set(HALF_MATRICES, self.half_matrices);
        features
    }
}
