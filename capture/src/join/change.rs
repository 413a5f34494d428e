//! Changes of the set of keyframes.

use keyframe::Keyframe;
use kinematics::Stamp;
use std::sync::Arc;

/// A change of the set of keyframes.
#[derive(Debug)]
pub enum Change {
    /// A new keyframe.
    Accepted(Arc<Keyframe>),
    /// A keyframe that was accepted before, with a more accurate pose.
    Revised(Arc<Keyframe>),
    /// A keyframe was evicted from the full store.
    Evicted {
        /// Name of its camera.
        camera: Arc<str>,
        /// Its stamp.
        stamp: Stamp,
    },
}
