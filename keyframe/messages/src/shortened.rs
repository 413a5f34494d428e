//! Shortens lists in messages.

use std::fmt::Display;

/// The first `max` items of a list, and the number of the other items, such as `a, b, c and 7
/// more`.
///
/// ```
/// use messages::shortened;
///
/// assert_eq!(shortened(&["a", "b", "c"], 3, ", "), "a, b, c");
/// assert_eq!(shortened(&["a", "b", "c"], 1, ", "), "a and 2 more");
/// // Items that contain commas themselves are separated by something else.
/// assert_eq!(shortened(&["a: 1, 2", "b: 3, 4", "c"], 2, "; "), "a: 1, 2; b: 3, 4; and 1 more");
/// ```
#[must_use]
pub fn shortened<T: Display>(items: &[T], max: usize, separator: &str) -> String {
    let shown: Vec<String> = items.iter().take(max).map(T::to_string).collect();
    let shown = shown.join(separator);
    match items.len().saturating_sub(max) {
        0 => shown,
        // There is no comma before "and".
        n_more => format!(
            "{shown}{} and {n_more} more",
            separator.trim_end_matches([',', ' '])
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::shortened;

    #[test]
    fn only_longer_lists_are_shortened() {
        let ids: Vec<u32> = (0..9).collect();
        assert_eq!(shortened(&ids[..0], 8, ", "), "");
        assert_eq!(shortened(&ids[..8], 8, ", "), "0, 1, 2, 3, 4, 5, 6, 7");
        assert_eq!(
            shortened(&ids, 8, ", "),
            "0, 1, 2, 3, 4, 5, 6, 7 and 1 more"
        );
        assert_eq!(shortened(&ids, 2, "; "), "0; 1; and 7 more");
    }
}
