//! Keyframes before and after an alignment of their cameras.

use keyframe::Keyframe;
use std::collections::HashMap;
use std::sync::Arc;

/// A keyframe with its corrections before and after an alignment.
#[derive(Clone, Debug)]
pub struct CorrectedKeyframe {
    /// The keyframe as it was pushed.
    pub before: Arc<Keyframe>,
    /// The keyframe with the new corrections.
    pub after: Arc<Keyframe>,
}

/// Replaces a keyframe with its version after the corrections.
pub(crate) fn replacement(keyframes: &[CorrectedKeyframe]) -> impl Fn(&mut Arc<Keyframe>) {
    let after: HashMap<_, _> = keyframes
        .iter()
        .map(|keyframe| (id_of(&keyframe.before), &keyframe.after))
        .collect();
    move |keyframe| {
        if let Some(after) = after.get(&id_of(keyframe)).copied() {
            *keyframe = Arc::clone(after);
        }
    }
}

/// Camera and stamp of a keyframe, nanoseconds.
pub(crate) fn id_of(keyframe: &Keyframe) -> (&str, i64) {
    (&keyframe.camera, keyframe.stamp.0)
}
