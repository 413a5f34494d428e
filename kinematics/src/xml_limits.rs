//! Limits of XML files, which are checked before the parser runs, because its time depends on them.

/// The parser's time grows with the square of the number of attributes of an element, and with the
/// cube of the number of nested namespaces.
const MAX_ATTRIBUTES: usize = 2000;
pub(crate) const MAX_NAMESPACES: usize = 100;
/// The parser's memory grows with the number of nodes.
pub(crate) const MAX_NODES: u32 = 1 << 20;

/// Checks the size and the structure of a file. The error is the reason.
pub(crate) fn check(xml: &str, max_bytes: usize) -> Result<(), String> {
    limited("bytes", xml.len(), max_bytes)?;
    limited("namespaces", xml.matches("xmlns").count(), MAX_NAMESPACES)?;
    // Attributes are counted in the text before parsing, because parsing takes most of the time.
    // The count may be too high, because values and comments also contain `=`.
    let n_attributes = |element: &str| element.bytes().filter(|byte| *byte == b'=').count();
    limited(
        "attributes in one element",
        xml.split('<').map(n_attributes).max().unwrap_or(0),
        MAX_ATTRIBUTES,
    )
}

/// Fails if the number `n` of things named `what` exceeds `max`.
fn limited(what: &str, n: usize, max: usize) -> Result<(), String> {
    if n <= max {
        return Ok(());
    }
    Err(format!("its {n} {what} exceed the maximum of {max}"))
}
