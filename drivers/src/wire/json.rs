//! JSON as Python writes it.

/// Replaces `NaN` and `Infinity` outside of strings with null. Python writes these words although
/// they are not valid JSON. If they are null, the reader can name their place or give them a
/// meaning.
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
