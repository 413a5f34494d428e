//! Names of the scene models.

/// The scene models there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ModelKind {
    /// 3D Gaussians.
    Splat,
    /// A distance field with a mesh, from depth.
    Tsdf,
    /// A neural field.
    Nerf,
}

impl ModelKind {
    /// All there are.
    pub(crate) const ALL: [Self; 3] = [Self::Splat, Self::Tsdf, Self::Nerf];

    /// The kind of a name.
    pub(crate) fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }

    /// Its name in files and on the command line.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Splat => "splat",
            Self::Tsdf => "tsdf",
            Self::Nerf => "nerf",
        }
    }
}
