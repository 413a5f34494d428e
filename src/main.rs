//! The `fieldrig` command.

fn main() {}
