//! JSON as Python writes it.

/// Replaces `NaN` and `Infinity` outside of strings with null. Python writes these words although
/// JSON does not have them. With null instead, the reader can name the place, or decide what the
/// value means.
pub(crate) fn nan_as_null(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for (ix, part) in text.split('"').enumerate() {
        if ix > 0 {
            out.push('"');
        }
        // An escaped quote in a name changes which parts count as strings. Names do not contain
        // these words, so this has no effect.
        if ix % 2 == 0 && (part.contains("NaN") || part.contains("Infinity")) {
            out.push_str(
                &part
                    .replace("-Infinity", "null")
                    .replace("Infinity", "null")
                    .replace("NaN", "null"),
            );
        } else {
            out.push_str(part);
        }
    }
    out
}
