//! What a kernel may use beyond the WebGPU defaults, and what happens without it.

use super::GpuOptions;

/// Optional abilities of the adapter; every one has a fallback.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Optional {
    /// Smallest number of lanes that run together, when subgroup operations may be used: 4 to 128.
    ///
    /// Without it sorting ranks sequentially and backward sums over its lanes through workgroup memory.
    pub subgroup_lanes: Option<u32>,
    /// GPU timestamps for per-pass times; without them only wall time is known.
    pub timestamps: bool,
    /// Atomic additions of floats; only a measurement wants them, and says where there are none.
    pub float_atomics: bool,
    /// Products of 16x16 matrices of f16, summed in f32, each worked out by a subgroup; without them neural fields work in f32.
    pub half_matrices: bool,
}

/// What kernels with matrices of f16 need.
const HALF_MATRICES: wgpu::Features = wgpu::Features::EXPERIMENTAL_COOPERATIVE_MATRIX.union(wgpu::Features::SHADER_F16);

/// Whether matrices of the size and types that our kernels have are among those that the adapter multiplies.
fn has_half_matrices(adapter: &wgpu::Adapter) -> bool {
    adapter.cooperative_matrix_properties().iter().any(|properties| {
        [properties.m_size, properties.n_size, properties.k_size] == [16; 3]
            && properties.ab_type == wgpu::CooperativeScalarType::F16
            && properties.cr_type == wgpu::CooperativeScalarType::F32
    })
}

impl Optional {
    /// What `adapter` offers of what may be used; nothing of it when `FIELDRIG_GPU_FEATURES=none` was asked for.
    pub(super) fn of(adapter: &wgpu::Adapter, options: &GpuOptions) -> Self {
        let allowed = options.optional_features;
        let features = adapter.features();
        let info = adapter.get_info();
        let same_size = info.subgroup_min_size == info.subgroup_max_size;
        let subgroups = features.contains(wgpu::Features::SUBGROUP) && same_size && info.subgroup_min_size >= 4;
        Self {
            subgroup_lanes: (allowed && subgroups).then_some(info.subgroup_min_size),
            timestamps: allowed && features.contains(wgpu::Features::TIMESTAMP_QUERY),
            float_atomics: allowed && options.float_atomics && features.contains(wgpu::Features::SHADER_FLOAT32_ATOMIC),
            half_matrices: allowed
                && options.matrices
                && subgroups
                && features.contains(HALF_MATRICES)
                && has_half_matrices(adapter),
        }
    }

    /// The wgpu features to ask for.
    pub(super) fn features(self) -> wgpu::Features {
        let mut features = wgpu::Features::empty();
        features.set(wgpu::Features::SUBGROUP, self.subgroup_lanes.is_some());
        features.set(wgpu::Features::TIMESTAMP_QUERY, self.timestamps);
        features.set(wgpu::Features::SHADER_FLOAT32_ATOMIC, self.float_atomics);
        features.set(HALF_MATRICES, self.half_matrices);
        features
    }
}
