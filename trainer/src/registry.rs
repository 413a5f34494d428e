//! Kinds of scene models and their names.

/// The kinds of scene models.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ModelKind {
    /// 3D Gaussian splats.
    Splat,
    /// A truncated signed distance field with a mesh, fused from depth.
    Tsdf,
    /// A neural radiance field.
    Nerf,
}

impl ModelKind {
    /// All kinds.
    pub(crate) const ALL: [Self; 3] = [Self::Splat, Self::Tsdf, Self::Nerf];

    /// The kind with this name.
    pub(crate) fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }

    /// The name in files and on the command line.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Splat => "splat",
            Self::Tsdf => "tsdf",
            Self::Nerf => "nerf",
        }
    }
}
