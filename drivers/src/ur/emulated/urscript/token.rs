//! Splits lines of URScript into tokens.

/// A part of a line.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Token {
    Name(String),
    Number(f64),
    Text(String),
    Symbol(&'static str),
}

/// Symbols; longer ones come first.
const SYMBOLS: [&str; 16] = [
    "==", "!=", "<=", ">=", "<", ">", "=", "+", "-", "*", "/", "(", ")", "[", "]", ",",
];

/// The tokens of a line. The colon that ends a line such as `if x:` is a symbol, too.
pub(super) fn tokens(line: &str) -> Result<Vec<Token>, String> {
    let mut tokens = Vec::new();
    let mut rest = line.trim();
    while let Some(first) = rest.chars().next() {
        let n_bytes = if first == '#' {
            break;
        } else if first == ':' {
            tokens.push(Token::Symbol(":"));
            1
        } else if first == '"' {
            let text = rest[1..].split_once('"');
            let (text, _) = text.ok_or_else(|| format!("a string does not end: {line}"))?;
            tokens.push(Token::Text(text.to_owned()));
            text.len() + 2
        } else if first.is_ascii_digit() {
            let n = length(rest, |c| c.is_ascii_digit() || c == '.');
            let number = rest[..n].parse();
            tokens.push(Token::Number(
                number.map_err(|_| format!("{:?} is not a number", &rest[..n]))?,
            ));
            n
        } else if first.is_alphabetic() || first == '_' {
            let n = length(rest, |c| c.is_alphanumeric() || c == '_');
            tokens.push(Token::Name(rest[..n].to_owned()));
            n
        } else {
            let symbol = SYMBOLS.iter().find(|symbol| rest.starts_with(*symbol));
            let symbol = symbol.ok_or_else(|| format!("{first:?} is not URScript: {line}"))?;
            tokens.push(Token::Symbol(symbol));
            symbol.len()
        };
        rest = rest[n_bytes..].trim_start();
    }
    Ok(tokens)
}

/// Bytes of the first characters that fulfill a condition.
fn length(text: &str, is_part: impl Fn(char) -> bool) -> usize {
    text.find(|c| !is_part(c)).unwrap_or(text.len())
}
