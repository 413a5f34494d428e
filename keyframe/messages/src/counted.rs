//! Formats counts and lists for messages.

/// A count and its noun: `1 image`, `2 images`.
#[must_use]
pub fn counted(n: u64, noun: &str) -> String {
    match noun.strip_suffix('y') {
        _ if n == 1 => format!("1 {noun}"),
        Some(stem) => format!("{n} {stem}ies"),
        None => format!("{n} {noun}s"),
    }
}

/// Words with commas, and a conjunction before the last word, such as `ply or spz`.
#[must_use]
pub fn listed(words: &[&str], conjunction: &str) -> String {
    match words.split_last() {
        Some((last, others)) if !others.is_empty() => {
            format!("{} {conjunction} {last}", others.join(", "))
        }
        _ => words.concat(),
    }
}
