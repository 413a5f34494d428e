//! Reasons why markers of a target were not found.

use crate::dictionary::Dictionary;
use crate::error::{Ids, NotDetected};
use crate::gray::Plane;
use crate::layout::layouts;
use crate::marker::{Exact, Marker, read_exactly};
use crate::quad::Quad;
use crate::spec::{Pattern, TargetSpec};

/// Fewer different markers without an error may be chance.
const MIN_MARKERS: usize = 3;
/// Cells per side from which a single marker without an error is no chance.
const MIN_BITS_OF_SINGLE: usize = 6;

/// Explains why the markers found in an image are not those of the target.
pub(super) fn markers(
    target: &TargetSpec,
    plane: &Plane,
    quads: &[Quad],
    dictionary: &Dictionary,
    markers: &[Marker],
) -> NotDetected {
    let n_on_target = match target.pattern {
        Pattern::Tag { .. } => 1,
        _ => layouts(&target.pattern).first().map_or(0, |layout| layout.corners_m.len()),
    };
    let first_id = if let Pattern::Tag { id, .. } = target.pattern { id } else { 0 };
    let expected = first_id..first_id + u32::try_from(n_on_target).unwrap_or(0);
    let mut ids: Vec<u32> = markers.iter().map(|marker| marker.id).collect();
    ids.dedup();
    let is_plausible =
        |n: usize, dictionary: &Dictionary| n >= MIN_MARKERS || (n > 0 && dictionary.n_bits() >= MIN_BITS_OF_SINGLE);
    if is_plausible(ids.len(), dictionary) {
        let n_expected = ids.iter().filter(|id| expected.contains(id)).count();
        let found = Ids(ids);
        return if 2 * n_expected < found.0.len() {
            NotDetected::OtherIds { found, expected: Ids(expected.collect()) }
        } else {
            NotDetected::OtherArrangement { found }
        };
    }
    // Number of markers, without those that may be chance.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a small positive number")]
    let n_certain = |exact: &Exact| exact.ids.len().saturating_sub((4.0 * exact.n_by_chance).ceil() as usize);
    let mirrored = read_exactly(plane, quads, dictionary, true);
    if is_plausible(n_certain(&mirrored), dictionary) {
        return NotDetected::Mirrored { n: mirrored.ids.len() };
    }
    let others = Dictionary::all().filter(|other| other != dictionary);
    let read = others.map(|other| (read_exactly(plane, quads, &other, false), other));
    // Of equals, the first: the smallest dictionary that contains all markers.
    let best = read.reduce(|best, next| if next.0.ids.len() > best.0.ids.len() { next } else { best });
    match best {
        Some((exact, found)) if is_plausible(n_certain(&exact), &found) => {
            let n = exact.ids.len();
            NotDetected::OtherDictionary { found: found.name().to_owned(), expected: dictionary.name().to_owned(), n }
        }
        _ => NotDetected::Nothing { target: target.kind() },
    }
}
