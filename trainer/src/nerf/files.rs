//! Names of the files of a saved field.

/// The field: a checkpoint of the arrays needed for rendering.
pub(super) const FIELD_FILE: &str = "field.nerf";
