//! Resolves `#import name` in WGSL sources, and inspects the sources with naga.

use crate::Error;
use wgpu::naga;

/// A WGSL file.
#[derive(Clone, Copy, Debug)]
pub struct Source {
    /// File name without `.wgsl`.
    pub name: &'static str,
    /// Contents.
    pub text: &'static str,
}

/// How a buffer is bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Access {
    Uniform,
    Read,
    ReadWrite,
}

/// One buffer of a kernel, from naga's reflection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Binding {
    pub(super) name: String,
    pub(super) number: u32,
    pub(super) access: Access,
}

/// Replaces each line `#import name` with the shared source of that name, recursively. Repeated
/// imports are skipped.
///
/// # Errors
///
/// Fails if a file imports a name that is not among the shared sources.
pub fn resolve(kernel: Source, shared: &[Source]) -> Result<String, Error> {
    let mut text = String::new();
    let mut seen = Vec::new();
    append(kernel, shared, &mut seen, &mut text)?;
    Ok(text)
}

fn append(
    source: Source,
    shared: &[Source],
    seen: &mut Vec<&'static str>,
    text: &mut String,
) -> Result<(), Error> {
    for line in source.text.lines() {
        let Some(name) = line.strip_prefix("#import ").map(str::trim) else {
            text.push_str(line);
            text.push('\n');
            continue;
        };
        let import = shared
            .iter()
            .find(|import| import.name == name)
            .ok_or_else(|| Error::UnknownImport {
                kernel: source.name,
                import: name.to_owned(),
            })?;
        // The import is marked before its own imports are resolved, so that circular imports end.
        if !seen.contains(&import.name) {
            seen.push(import.name);
            append(*import, shared, seen, text)?;
        }
    }
    Ok(())
}

/// Parses and validates WGSL.
///
/// # Errors
///
/// Fails if the WGSL is invalid. The message names the kernel.
pub fn reflect(name: &'static str, text: &str) -> Result<naga::Module, Error> {
    let rejected = |message: String| Error::Wgsl {
        kernel: name,
        message,
    };
    // All capabilities are allowed here, because wgpu checks the capabilities of the adapter when
    // it creates the module.
    let module =
        naga::front::wgsl::parse_str(text).map_err(|error| rejected(error.emit_to_string(text)))?;
    naga::valid::Validator::new(
        naga::valid::ValidationFlags::all(),
        naga::valid::Capabilities::all(),
    )
    .validate(&module)
    .map_err(|error| rejected(error.emit_to_string(text)))?;
    Ok(module)
}

/// Workgroup memory that a kernel uses, bytes.
pub(super) fn workgroup_bytes(module: &naga::Module) -> u32 {
    let shared = module
        .global_variables
        .iter()
        .filter(|(_, variable)| variable.space == naga::AddressSpace::WorkGroup);
    shared
        .map(|(_, variable)| module.types[variable.ty].inner.size(module.to_ctx()))
        .sum()
}

/// The buffers of group 0 in order of their numbers.
pub(super) fn bindings(module: &naga::Module) -> Vec<Binding> {
    let mut found: Vec<Binding> = module
        .global_variables
        .iter()
        .filter_map(|(_, variable)| {
            let access = match variable.space {
                naga::AddressSpace::Uniform => Access::Uniform,
                naga::AddressSpace::Storage { access }
                    if access.contains(naga::StorageAccess::STORE) =>
                {
                    Access::ReadWrite
                }
                naga::AddressSpace::Storage { .. } => Access::Read,
                _ => return None,
            };
            // Private and workgroup variables have no binding, because they are not buffers.
            let number = variable.binding.as_ref()?.binding;
            Some(Binding {
                name: variable.name.clone()?,
                number,
                access,
            })
        })
        .collect();
    // A file may declare its bindings in any order, and the bindings of imports come first.
    found.sort_by_key(|binding| binding.number);
    found
}
