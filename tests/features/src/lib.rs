//! This package contains only dependencies and no code.
//!
//! Cargo compiles a dependency with the features that all selected packages need together. The
//! optional features of this workspace bring more dependencies. These need more features of other
//! dependencies, such as `syn`, on which all derive macros depend. Without this package, `cargo
//! clippy --no-default-features` compiles a hundred dependencies again.
