//! Compute pipelines whose bindings are found by their names in the WGSL.

use super::wgsl::{Access, Binding};
use super::{Gpu, Source, reflect, resolve, wgsl};
use crate::Error;
use rayon::prelude::*;

/// A kernel: its WGSL file and the files it may import.
#[derive(Clone, Copy, Debug)]
pub struct Kernel {
    /// The file with the entry point `main`.
    pub source: Source,
    /// Files it may import.
    pub shared: &'static [Source],
}

/// A compiled kernel.
#[derive(Debug)]
pub struct Pipeline {
    pub(super) id: u64,
    pub(super) name: &'static str,
    pub(super) raw: wgpu::ComputePipeline,
    pub(super) layout: wgpu::BindGroupLayout,
    pub(super) bindings: Vec<Binding>,
}

impl Pipeline {
    /// Compiles `kernel` with the given values of its `override`s.
    pub fn new(gpu: &Gpu, kernel: Kernel, overrides: &[(&str, f64)]) -> Result<Self, Error> {
        let name = kernel.source.name;
        let text = resolve(kernel.source, kernel.shared)?;
        let module = reflect(name, &text)?;
        let (bytes, limit_bytes) = (wgsl::workgroup_bytes(&module), gpu.max_workgroup_bytes());
        if bytes > limit_bytes {
            return Err(Error::WorkgroupTooLarge { kernel: name, bytes, limit_bytes });
        }
        let bindings = wgsl::bindings(&module);
        let device = &gpu.device;
        let described =
            wgpu::ShaderModuleDescriptor { label: Some(name), source: wgpu::ShaderSource::Wgsl(text.into()) };
        let checks = wgpu::ShaderRuntimeChecks { force_loop_bounding: false, ..wgpu::ShaderRuntimeChecks::checked() };
        // SAFETY: every loop of our kernels counts to a bound that is fixed before it starts.
        #[expect(unsafe_code, reason = "a second bound would cost time in every iteration of the innermost loops")]
        let shader = unsafe { device.create_shader_module_trusted(described, checks) };
        let entries: Vec<wgpu::BindGroupLayoutEntry> = bindings
            .iter()
            .map(|binding| wgpu::BindGroupLayoutEntry {
                binding: binding.number,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer {
                    ty: match binding.access {
                        Access::Uniform => wgpu::BufferBindingType::Uniform,
                        Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
                        Access::ReadWrite => wgpu::BufferBindingType::Storage { read_only: false },
                    },
                    has_dynamic_offset: false,
                    min_binding_size: None,
                },
                count: None,
            })
            .collect();
        let layout =
            device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(name), entries: &entries });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(name),
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let raw = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(name),
            layout: Some(&pipeline_layout),
            module: &shader,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions {
                constants: overrides,
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        });
        Ok(Self { id: gpu.next_unique_id(), name, raw, layout, bindings })
    }

    /// Compiles several kernels in parallel, because drivers take up to a tenth of a second for each.
    pub fn compile_all<const N: usize>(gpu: &Gpu, kernels: [(Kernel, &[(&str, f64)]); N]) -> Result<[Self; N], Error> {
        let compiled: Vec<Self> = kernels
            .into_par_iter()
            .map(|(kernel, overrides)| Self::new(gpu, kernel, overrides))
            .collect::<Result<_, _>>()?;
        Ok(compiled.try_into().expect("as many pipelines as kernels"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::GpuOptions;

    #[test]
    fn kernel_exceeding_workgroup_memory_is_rejected() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let text = "var<workgroup> wg_all: array<vec4f, 100000>;
            @compute @workgroup_size(64)
            fn main(@builtin(local_invocation_index) lane: u32) { wg_all[lane] = vec4f(0.0); }";
        let kernel = Kernel { source: Source { name: "large", text }, shared: &[] };
        let rejected = Pipeline::new(&gpu, kernel, &[]).unwrap_err();
        assert!(matches!(rejected, Error::WorkgroupTooLarge { kernel: "large", bytes: 1_600_000, .. }), "{rejected}");
    }
}
