//! Helpers for tests: shared devices, and checks that kernels are valid and that their structs have
//! the same layout in Rust and WGSL.

pub use crate::assert_layout;

use crate::{Error, Gpu, GpuOptions, Kernel, reflect, resolve};
use parking_lot::Mutex;
use std::sync::Arc;

/// Devices of finished tests, with the options with which they were opened.
static DEVICES: Mutex<Vec<(GpuOptions, Arc<Gpu>)>> = Mutex::new(Vec::new());

/// A device that no other test uses at the same time. An earlier test may have used it, so its
/// pipelines may already be compiled. It has no buffers left. Tests of the device itself open their
/// own device.
#[must_use]
pub fn test_gpu() -> Arc<Gpu> {
    test_gpu_with(&GpuOptions::default())
}

/// [`test_gpu`] with options.
#[must_use]
pub fn test_gpu_with(options: &GpuOptions) -> Arc<Gpu> {
    let mut devices = DEVICES.lock();
    devices.retain(|(_, gpu)| gpu.check().is_ok());
    // The only other owners of a device are the test that uses it and its models, which may drop
    // buffers last.
    let is_free = |gpu: &Arc<Gpu>| Arc::strong_count(gpu) == 1 && gpu.live_bytes() == 0;
    if let Some((_, gpu)) = devices
        .iter()
        .find(|(opened, gpu)| opened == options && is_free(gpu))
    {
        return gpu.clone();
    }
    let gpu = Gpu::open(options).expect("tests need a GPU or a software adapter");
    if devices.is_empty() {
        close_devices_at_exit();
    }
    devices.push((*options, gpu.clone()));
    gpu
}

/// NVIDIA's driver may crash if a device is open when the process exits. The handler is registered
/// after the driver's own handlers, so it runs before them.
fn close_devices_at_exit() {
    extern "C" fn close_devices() {
        DEVICES.lock().clear();
    }
    static REGISTER: std::sync::Once = std::sync::Once::new();
    REGISTER.call_once(|| {
        #[expect(
            unsafe_code,
            reason = "the test harness cannot call a function after the last test"
        )]
        // SAFETY: the handler is a function without arguments that does not unwind.
        let status = unsafe { libc::atexit(close_devices) };
        assert_eq!(status, 0, "the C library keeps at least 32 handlers");
    });
}

/// If set to `demand`, tests that need a real GPU fail without one instead of being skipped. `make
/// test-gpu` sets it.
const DEMAND_VARIABLE: &str = "FIELDRIG_GPU_TESTS";

/// Options of a device with cooperative matrices of f16 numbers. If the adapter has none, reports
/// the calling test as skipped and returns `None`.
#[must_use]
pub fn options_with_matrices() -> Option<GpuOptions> {
    let options = GpuOptions::default();
    has(
        &options,
        test_gpu().optional().half_matrices,
        "cooperative matrices of f16 numbers",
    )
    .then_some(options)
}

/// Options of a device with subgroups of at least 16 lanes. If the adapter has none, reports the
/// calling test as skipped and returns `None`. Lavapipe has them if `LP_NATIVE_VECTOR_WIDTH` is
/// 512.
#[must_use]
pub fn options_with_large_subgroups() -> Option<GpuOptions> {
    let options = GpuOptions::default();
    let is_large = test_gpu()
        .optional()
        .subgroup_lanes
        .is_some_and(|lanes| lanes >= 16);
    has(&options, is_large, "subgroups of 16 or more lanes").then_some(options)
}

/// Reports the calling test as skipped if the adapter does not have a feature.
fn has(options: &GpuOptions, is_available: bool, feature: &str) -> bool {
    if !is_available {
        let reason = format!("{} has no {feature}", test_gpu_with(options).describe());
        assert!(
            !std::env::var(DEMAND_VARIABLE).is_ok_and(|value| value == "demand"),
            "this test needs a GPU: {reason}"
        );
        test_support::skip(reason);
    }
    is_available
}

/// Names and offsets in bytes of the fields of a struct, and its size.
pub type StructLayout = (Vec<(String, usize)>, usize);

/// Asserts that the kernels parse and validate.
pub fn assert_valid<'k>(kernels: impl IntoIterator<Item = &'k Kernel>) {
    let errors: Vec<String> = kernels
        .into_iter()
        .filter_map(validation_error)
        .map(|error| error.to_string())
        .collect();
    assert!(errors.is_empty(), "{}", errors.join("\n"));
}

/// Why a kernel is invalid. `None` if it is valid.
fn validation_error(kernel: &Kernel) -> Option<Error> {
    let validate = |text: String| reflect(kernel.source.name, &text).map(drop);
    resolve(kernel.source, kernel.shared)
        .and_then(validate)
        .err()
}

/// Parses a kernel that must be valid.
fn module_of(kernel: &Kernel) -> wgpu::naga::Module {
    let text = resolve(kernel.source, kernel.shared).expect("all imports are known");
    reflect(kernel.source.name, &text).expect("the kernel is valid")
}

/// The layout of the WGSL struct `name`. Asserts that all kernels that declare the struct agree.
#[must_use]
pub fn layout_in_wgsl(kernels: &[Kernel], name: &str) -> StructLayout {
    let layouts: Vec<StructLayout> = kernels
        .iter()
        .filter_map(|kernel| declared_layout(kernel, name))
        .collect();
    let first = layouts
        .first()
        .unwrap_or_else(|| panic!("no kernel declares {name}"));
    assert!(
        layouts.iter().all(|layout| layout == first),
        "{name} differs between kernels: {layouts:?}"
    );
    first.clone()
}

/// The layout of a struct in one kernel. `None` if the kernel does not declare it.
fn declared_layout(kernel: &Kernel, name: &str) -> Option<StructLayout> {
    let module = module_of(kernel);
    module
        .types
        .iter()
        .find_map(|(_, found)| match &found.inner {
            wgpu::naga::TypeInner::Struct { members, span }
                if found.name.as_deref() == Some(name) =>
            {
                let fields = members
                    .iter()
                    .map(|member| (name_of(member), member.offset as usize));
                Some((fields.collect(), *span as usize))
            }
            _ => None,
        })
}

fn name_of(member: &wgpu::naga::StructMember) -> String {
    member.name.clone().expect("fields in WGSL have names")
}

/// The value of the WGSL constant `name`, a u32. Asserts that all kernels that declare the constant
/// agree.
#[must_use]
pub fn constant_in_wgsl(kernels: &[Kernel], name: &str) -> u32 {
    let values: Vec<u32> = kernels
        .iter()
        .filter_map(|kernel| declared_constant(kernel, name))
        .collect();
    let first = *values
        .first()
        .unwrap_or_else(|| panic!("no kernel declares {name}"));
    assert!(
        values.iter().all(|value| *value == first),
        "{name} differs between kernels: {values:?}"
    );
    first
}

/// The value of a constant in one kernel. `None` if the kernel does not declare it.
fn declared_constant(kernel: &Kernel, name: &str) -> Option<u32> {
    let module = module_of(kernel);
    let (_, constant) = module
        .constants
        .iter()
        .find(|(_, constant)| constant.name.as_deref() == Some(name))?;
    match module.global_expressions[constant.init] {
        wgpu::naga::Expression::Literal(wgpu::naga::Literal::U32(value)) => Some(value),
        ref other => panic!("{name} is {other:?}"),
    }
}

/// Asserts that a struct has these fields, in this order and at the same offsets, in Rust and in
/// the WGSL of `$kernels`.
#[macro_export]
macro_rules! assert_layout {
    ($kernels:expr, $type:ident, [$($field:ident),* $(,)?]) => {
        let in_rust = (
            vec![$((stringify!($field).to_owned(), std::mem::offset_of!($type, $field))),*],
            size_of::<$type>(),
        );
        assert_eq!(in_rust, $crate::testing::layout_in_wgsl($kernels, stringify!($type)), stringify!($type));
    };
}
