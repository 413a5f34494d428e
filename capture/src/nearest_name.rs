//! Suggestions for misspelled names.

/// Less similar names are not misspellings of each other. With a lower limit, unrelated names would
/// be suggested. With a higher limit, real misspellings would get no suggestion. Jaro-Winkler
/// similarity also rewards a common prefix, so that `focal` suggests `focal_px`.
const MIN_SIMILARITY: f64 = 0.75;

/// The known name that is most similar to an unknown one; `None` if none is similar.
pub fn nearest_name<'a>(
    unknown: &str,
    known: impl IntoIterator<Item = &'a str>,
) -> Option<&'a str> {
    let similarity = |name: &str| strsim::jaro_winkler(unknown, name);
    let nearest = known
        .into_iter()
        .max_by(|a, b| similarity(a).total_cmp(&similarity(b)));
    nearest.filter(|name| similarity(name) > MIN_SIMILARITY)
}

#[cfg(test)]
mod tests {
    use super::nearest_name;

    #[test]
    fn only_similar_names_are_suggested() {
        let known = ["focal_px", "principal_px", "distortion"];
        assert_eq!(nearest_name("focal", known), Some("focal_px"));
        assert_eq!(nearest_name("principle_px", known), Some("principal_px"));
        assert_eq!(nearest_name("xyz", known), None);
    }
}
