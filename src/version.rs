//! What `fieldrig --version` prints: the version, and how this program was built.

/// For `-V`: the version and the commit of the source.
pub(crate) const SHORT: &str = concat!(
    env!("CARGO_PKG_VERSION"),
    " (",
    env!("FIELDRIG_COMMIT"),
    ")"
);

/// For `--version`, in one line: also the profile and the features of the build.
pub(crate) const LONG: &str = concat!(
    env!("CARGO_PKG_VERSION"),
    " (",
    env!("FIELDRIG_COMMIT"),
    ", ",
    env!("FIELDRIG_BUILD"),
    ")"
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn version_names_commit_profile_and_features_in_one_line() {
        assert!(!LONG.contains('\n') && LONG.starts_with(SHORT.trim_end_matches(')')));
        let commit = env!("FIELDRIG_COMMIT");
        let hash = commit.split(' ').next().unwrap_or_default();
        assert!(
            commit == "unknown" || hash.chars().all(|c| c.is_ascii_hexdigit()),
            "{commit}"
        );
        let build = env!("FIELDRIG_BUILD");
        let profile = if cfg!(debug_assertions) {
            "debug build"
        } else {
            "release build"
        };
        assert!(build.starts_with(profile), "{build}");
        for (name, is_on) in [
            ("lpips", cfg!(feature = "lpips")),
            ("sim", cfg!(feature = "sim")),
            ("realsense", cfg!(feature = "realsense")),
            ("nokhwa", cfg!(feature = "nokhwa")),
            ("foxglove", cfg!(feature = "foxglove")),
        ] {
            assert_eq!(build.contains(name), is_on, "{name} in {build}");
        }
    }
}
