//! Says what a rig file means, so that users notice mistakes that no check can find.

use super::Finding;
use crate::config::Rig;
use crate::rig_facts::{RigFacts, Sentence, sentences};

/// The facts of a rig as findings. Probable mistakes are warnings.
///
/// # Errors
///
/// As for [`RigFacts::of`].
pub fn meaning(rig: &Rig) -> anyhow::Result<Vec<Finding>> {
    let facts = RigFacts::of(rig)?;
    Ok(sentences(&facts).into_iter().map(finding).collect())
}

fn finding(Sentence { text, remedy }: Sentence) -> Finding {
    match remedy {
        None => Finding::ok("rig", text),
        Some(remedy) => Finding::warn("rig", text, remedy),
    }
}
