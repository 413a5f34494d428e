//! Points on the surfaces of a scene, from which a model starts if there is no depth.

/// Points from another program, for example from structure from motion.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct InitialPoints {
    /// Positions in world, meters. All coordinates are finite.
    pub points_in_world_m: Vec<[f32; 3]>,
    /// sRGB color of each point. The list is empty if the colors are unknown.
    pub colors_srgb: Vec<[u8; 3]>,
}
