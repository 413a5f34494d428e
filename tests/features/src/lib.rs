//! Nothing; see the dependencies of this package.
//!
//! Cargo compiles a dependency with the features that all selected packages need together. The
//! optional features of this workspace bring dependencies that need more features of others, such
//! as those of `syn`, on which all derive macros depend. Without this package, `cargo clippy
//! --no-default-features` compiles a hundred dependencies again.
