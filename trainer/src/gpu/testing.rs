//! Test helpers that check that kernels are valid, and that their structs have the same layout in Rust and WGSL.

use super::{Kernel, reflect, resolve};

/// Names and offsets in bytes of the fields of a struct, and its size.
pub(crate) type StructLayout = (Vec<(String, usize)>, usize);

/// Asserts that the kernels parse and validate.
pub(crate) fn assert_valid<'k>(kernels: impl IntoIterator<Item = &'k Kernel>) {
    let error = |kernel: &Kernel| {
        let validate = |text: String| reflect(kernel.source.name, &text).map(drop);
        resolve(kernel.source, kernel.shared).and_then(validate).err()
    };
    let errors: Vec<String> = kernels.into_iter().filter_map(error).map(|error| error.to_string()).collect();
    assert!(errors.is_empty(), "{}", errors.join("\n"));
}

/// The layout of the WGSL struct `name`. Asserts that all kernels that declare the struct agree.
pub(crate) fn layout_in_wgsl(kernels: &[Kernel], name: &str) -> StructLayout {
    let layout = |kernel: &Kernel| {
        let module = reflect(kernel.source.name, &resolve(kernel.source, kernel.shared).unwrap()).unwrap();
        module.types.iter().find_map(|(_, found)| match &found.inner {
            wgpu::naga::TypeInner::Struct { members, span } if found.name.as_deref() == Some(name) => {
                let fields = members.iter().map(|member| (member.name.clone().unwrap(), member.offset as usize));
                Some((fields.collect(), *span as usize))
            }
            _ => None,
        })
    };
    let layouts: Vec<StructLayout> = kernels.iter().filter_map(layout).collect();
    let first = layouts.first().unwrap_or_else(|| panic!("no kernel declares {name}"));
    assert!(layouts.iter().all(|layout| layout == first), "{name} differs between kernels: {layouts:?}");
    first.clone()
}

/// The value of the WGSL constant `name`, a u32. Asserts that all kernels that declare the constant agree.
pub(crate) fn constant_in_wgsl(kernels: &[Kernel], name: &str) -> u32 {
    let value = |kernel: &Kernel| {
        let module = reflect(kernel.source.name, &resolve(kernel.source, kernel.shared).unwrap()).unwrap();
        let (_, constant) = module.constants.iter().find(|(_, constant)| constant.name.as_deref() == Some(name))?;
        match module.global_expressions[constant.init] {
            wgpu::naga::Expression::Literal(wgpu::naga::Literal::U32(value)) => Some(value),
            ref other => panic!("{name} is {other:?}"),
        }
    };
    let values: Vec<u32> = kernels.iter().filter_map(value).collect();
    let first = *values.first().unwrap_or_else(|| panic!("no kernel declares {name}"));
    assert!(values.iter().all(|value| *value == first), "{name} differs between kernels: {values:?}");
    first
}

/// Asserts that a struct has these fields, in this order and at the same offsets, in Rust and in the WGSL of `$kernels`.
macro_rules! assert_layout {
    ($kernels:expr, $type:ident, [$($field:ident),* $(,)?]) => {
        let in_rust = (
            vec![$((stringify!($field).to_owned(), std::mem::offset_of!($type, $field))),*],
            size_of::<$type>(),
        );
        assert_eq!(in_rust, $crate::gpu::testing::layout_in_wgsl($kernels, stringify!($type)), stringify!($type));
    };
}
pub(crate) use assert_layout;
