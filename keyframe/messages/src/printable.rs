//! Text of other programs on a terminal.

use std::borrow::Cow;

/// Escapes control characters other than line breaks and tabs, and characters that change the
/// direction of text. A terminal would interpret these characters.
#[must_use]
pub fn printable(text: &str) -> Cow<'_, str> {
    // Almost all texts need no escapes, and are not copied.
    if !text.contains(is_hidden) {
        return text.into();
    }
    let mut escaped = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if is_hidden(c) {
            escaped.extend(c.escape_unicode());
        } else {
            escaped.push(c);
        }
    }
    escaped.into()
}

fn is_hidden(c: char) -> bool {
    (c.is_control() && !matches!(c, '\n' | '\t'))
        || matches!(c, '\u{202A}'..='\u{202E}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_escaped() {
        for plain in ["a\tb\nc", "Größe 5 µm → 3 Ω", ""] {
            assert!(matches!(printable(plain), Cow::Borrowed(_)), "{plain}");
        }
        assert_eq!(
            printable("\x1b]0;title\x07\x1b[2J"),
            "\\u{1b}]0;title\\u{7}\\u{1b}[2J"
        );
        assert_eq!(
            printable("\u{9b}31m\u{7f}\r\u{202e}x"),
            "\\u{9b}31m\\u{7f}\\u{d}\\u{202e}x"
        );
    }
}
