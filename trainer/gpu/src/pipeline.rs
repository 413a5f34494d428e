//! Compute pipelines whose bindings are found by their names in the WGSL.

use crate::pipeline_cache::Key;
use crate::wgsl::{Access, Binding};
use crate::{Error, Gpu, Pipeline, Source, reflect, resolve, wgsl};
use rayon::prelude::*;
use std::borrow::Cow;
use std::sync::Arc;

/// A kernel, given by its WGSL file and the files that it may import.
#[derive(Clone, Copy, Debug)]
pub struct Kernel {
    /// The file with the entry point `main`.
    pub source: Source,
    /// Files it may import.
    pub shared: &'static [Source],
}

impl Pipeline {
    /// Compiles `kernel` with the given values of its `override`s. If this device has already
    /// compiled such a pipeline, returns that pipeline.
    ///
    /// # Errors
    ///
    /// Fails if the WGSL is invalid, or needs more workgroup memory than the adapter has.
    pub fn new(gpu: &Gpu, kernel: Kernel, overrides: &[(&str, f64)]) -> Result<Self, Error> {
        let text = resolve(kernel.source, kernel.shared)?;
        let key = Key::new(text.clone(), overrides);
        gpu.pipelines.get_or_compile(key, || {
            Self::compile(gpu, kernel.source.name, &text, overrides)
        })
    }

    /// Compiles WGSL that contains all imports.
    fn compile(
        gpu: &Gpu,
        name: &'static str,
        text: &str,
        overrides: &[(&str, f64)],
    ) -> Result<Self, Error> {
        let module = reflect(name, text)?;
        // The size is checked here, so that the error contains the numbers. Otherwise, wgpu would
        // later report an invalid pipeline, which looks like a bug of this program.
        let bytes = wgsl::workgroup_bytes(&module);
        let limit_bytes = gpu.max_workgroup_bytes();
        if bytes > limit_bytes {
            return Err(Error::WorkgroupTooLarge {
                kernel: name,
                bytes,
                limit_bytes,
            });
        }
        // The bindings come from the WGSL, so that the Rust code contains no binding numbers and
        // wrong names are detected.
        let bindings: Arc<[Binding]> = wgsl::bindings(&module).into();
        let device = &gpu.device;
        let source = wgpu::ShaderSource::Naga(Cow::Owned(module));
        let described = wgpu::ShaderModuleDescriptor {
            label: Some(name),
            source,
        };
        let checks = wgpu::ShaderRuntimeChecks {
            force_loop_bounding: false,
            ..wgpu::ShaderRuntimeChecks::checked()
        };
        #[expect(
            unsafe_code,
            reason = "a second bound would cost time in every iteration of the innermost loops"
        )]
        // SAFETY: every loop of fieldrig's kernels counts to a bound that is fixed before the loop
        // starts.
        let shader = unsafe { device.create_shader_module_trusted(described, checks) };
        // The layout is explicit and has all declared buffers. A layout that wgpu derives would
        // lack the buffers that this variant of the kernel does not use. Callers of `dispatch`
        // would then have to know which buffers each variant uses.
        let entries: Vec<_> = bindings.iter().map(layout_entry).collect();
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some(name),
            entries: &entries,
        });
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
                // Kernels write workgroup memory before they read it.
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        });
        Ok(Self {
            id: gpu.next_unique_id(),
            name,
            raw,
            layout,
            bindings,
        })
    }

    /// Compiles several kernels in parallel, because drivers take up to a tenth of a second for
    /// each.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::new`] does, for any of the kernels.
    pub fn compile_all<const N: usize>(
        gpu: &Gpu,
        kernels: [(Kernel, &[(&str, f64)]); N],
    ) -> Result<[Self; N], Error> {
        let compiled: Vec<Self> = kernels
            .into_par_iter()
            .map(|(kernel, overrides)| Self::new(gpu, kernel, overrides))
            .collect::<Result<_, _>>()?;
        Ok(compiled.try_into().expect("as many pipelines as kernels"))
    }
}

fn layout_entry(binding: &Binding) -> wgpu::BindGroupLayoutEntry {
    let ty = match binding.access {
        Access::Uniform => wgpu::BufferBindingType::Uniform,
        Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
        Access::ReadWrite => wgpu::BufferBindingType::Storage { read_only: false },
    };
    wgpu::BindGroupLayoutEntry {
        binding: binding.number,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Buffer {
            ty,
            has_dynamic_offset: false,
            min_binding_size: None,
        },
        count: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{GpuOptions, Passes};

    #[test]
    fn kernel_exceeding_workgroup_memory_is_rejected() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let text = "var<workgroup> wg_all: array<vec4f, 100000>;
            @compute @workgroup_size(64)
            fn main(@builtin(local_invocation_index) lane: u32) { wg_all[lane] = vec4f(0.0); }";
        let kernel = Kernel {
            source: Source {
                name: "large",
                text,
            },
            shared: &[],
        };
        for _ in 0..2 {
            let rejected = Pipeline::new(&gpu, kernel, &[]).unwrap_err();
            let is_expected = matches!(
                rejected,
                Error::WorkgroupTooLarge {
                    kernel: "large",
                    bytes: 1_600_000,
                    ..
                }
            );
            assert!(is_expected, "{rejected}");
        }
    }

    /// A pipeline is compiled once per text and overrides, also if several threads ask for it at
    /// the same time.
    #[test]
    fn pipelines_are_compiled_once_per_text_and_overrides() {
        const FIRST: &str = "
            override VALUE = 1u;
            @group(0) @binding(0) var<storage, read_write> output: array<u32>;
            @compute @workgroup_size(1)
            fn main() { output[0] = VALUE; }";
        const SECOND: &str = "
            override VALUE = 1u;
            @group(0) @binding(0) var<storage, read_write> output: array<u32>;
            @compute @workgroup_size(1)
            fn main() { output[0] = VALUE + 10u; }";
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let output = gpu.storage("output", 4).unwrap();
        let mut passes = Passes::default();
        let mut result = |text: &'static str, overrides: &[(&str, f64)]| {
            let kernel = Kernel {
                source: Source {
                    name: "constant",
                    text,
                },
                shared: &[],
            };
            let compiled = (0..4)
                .into_par_iter()
                .map(|_| Pipeline::new(&gpu, kernel, overrides).unwrap());
            let compiled: Vec<Pipeline> = compiled.collect();
            assert!(
                compiled
                    .iter()
                    .all(|pipeline| pipeline.id == compiled[0].id)
            );
            passes.dispatch(&gpu, &compiled[0], 1, &[("output", &output)]);
            passes.submit(&gpu);
            (gpu.read::<u32>(&output, 1).unwrap()[0], gpu.pipelines.len())
        };
        assert_eq!(result(FIRST, &[]), (1, 1));
        assert_eq!(result(FIRST, &[("VALUE", 5.0)]), (5, 2));
        assert_eq!(result(SECOND, &[("VALUE", 5.0)]), (15, 3));
        assert_eq!(result(FIRST, &[("VALUE", 5.0)]), (5, 3), "already compiled");
    }
}
