//! Carries the comments of a rig file over to another text of the same rig.
//!
//! The effective rig file is written from the checked rig, which has no comments. Comments belong to
//! the key or table below them, or beside them. They are found again by its path.

use crate::init::GUESS;
use std::collections::BTreeMap;
use std::ops::Range;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// Numbers that differ by less, relative to their size, count as the same. Poses are rounded when
/// they are written.
const TOLERANCE: f64 = 1e-5;

/// Names of a key or table and of its parents, from the outermost.
type KeyPath = Vec<String>;

/// The text `new` with the comments of the text `old`. Comments of keys that `new` does not have are
/// moved to the table that would contain them. A comment that marks a value as a guess is left out if
/// the value has changed. `None` if a text is not TOML.
pub(super) fn carried(old: &str, new: &str) -> Option<String> {
    let values: Table = toml::from_str(new).ok()?;
    let before: Table = toml::from_str(old).ok()?;
    let mut comments = Comments::of(old)?;
    for comment in &mut comments.of_items {
        if is_changed(at(&before, &comment.path), at(&values, &comment.path)) {
            let is_guess = |line: &&str| line.trim_start_matches('#').trim().starts_with(GUESS);
            let n_kept = comment.above.iter().position(is_guess);
            comment
                .above
                .truncate(n_kept.unwrap_or(comment.above.len()));
        }
    }
    let text = comments.insert_into(new)?;
    // Comments must not change a value.
    (toml::from_str::<Table>(&text).ok()? == values).then_some(text)
}

/// Comments of a text.
struct Comments<'a> {
    /// Lines at the beginning, before an empty line.
    head: Vec<&'a str>,
    of_items: Vec<ItemComments<'a>>,
    /// Lines after the last key.
    tail: Vec<&'a str>,
}

/// Comments of a key or table.
struct ItemComments<'a> {
    path: KeyPath,
    /// Lines above it.
    above: Vec<&'a str>,
    /// The end of its line.
    beside: Option<&'a str>,
}

impl<'a> Comments<'a> {
    fn of(text: &'a str) -> Option<Self> {
        let Items { by_line, strings } = Items::of(text)?;
        let mut comments = Self {
            head: Vec::new(),
            of_items: Vec::new(),
            tail: Vec::new(),
        };
        let mut above: Vec<&str> = Vec::new();
        let mut start = 0;
        for (ix, line) in text.split_inclusive('\n').enumerate() {
            let trimmed = line.trim();
            let is_in_string = strings.iter().any(|range| range.contains(&start));
            if trimmed.starts_with('#') && !is_in_string {
                above.push(trimmed);
            } else if trimmed.is_empty() && comments.is_empty() {
                comments.head = std::mem::take(&mut above);
            } else if let Some(item) = by_line.get(&ix) {
                comments.of_items.push(ItemComments {
                    path: item.path.clone(),
                    above: std::mem::take(&mut above),
                    beside: beside(text, item),
                });
            }
            start += line.len();
        }
        comments.tail = above;
        Some(comments)
    }

    fn is_empty(&self) -> bool {
        self.head.is_empty() && self.of_items.is_empty()
    }

    fn insert_into(&self, text: &str) -> Option<String> {
        let items = Items::of(text)?;
        let by_path: BTreeMap<&KeyPath, &Item> = items
            .by_line
            .values()
            .map(|item| (&item.path, item))
            .collect();
        let mut above: BTreeMap<usize, Vec<&str>> = BTreeMap::new();
        let mut beside: BTreeMap<usize, &str> = BTreeMap::new();
        let mut tail = self.tail.clone();
        for comment in &self.of_items {
            let mut path = comment.path.clone();
            let found = loop {
                if let Some(item) = by_path.get(&path) {
                    break Some(item);
                }
                if path.pop().is_none() {
                    break None;
                }
            };
            match found {
                Some(item) if item.path == comment.path => {
                    above.entry(item.line).or_default().extend(&comment.above);
                    if let Some(text) = comment.beside {
                        beside.insert(item.last_line, text);
                    }
                }
                Some(item) => {
                    let lines = above.entry(item.line).or_default();
                    lines.extend(comment.above.iter().copied().chain(comment.beside));
                }
                None => tail.extend(comment.above.iter().copied().chain(comment.beside)),
            }
        }
        let mut lines: Vec<String> = self.head.iter().map(|line| (*line).to_owned()).collect();
        if !lines.is_empty() {
            lines.push(String::new());
        }
        for (ix, line) in text.lines().enumerate() {
            lines.extend(above.remove(&ix).into_iter().flatten().map(str::to_owned));
            lines.push(match beside.get(&ix) {
                Some(comment) => format!("{line} {comment}"),
                None => line.to_owned(),
            });
        }
        lines.extend(tail.into_iter().map(str::to_owned));
        Some(lines.join("\n") + "\n")
    }
}

/// The keys and tables of a text.
struct Items {
    /// By the line on which they begin, from 0.
    by_line: BTreeMap<usize, Item>,
    /// Positions of the strings of several lines. They may contain lines that look like comments.
    strings: Vec<Range<usize>>,
}

/// A key with its value, or the header of a table.
struct Item {
    path: KeyPath,
    /// Its first line, from 0.
    line: usize,
    /// Its last line, from 0.
    last_line: usize,
    /// Position after the value of a key, or after the name in the header of a table.
    end: usize,
    is_header: bool,
}

/// A key in a text.
struct KeyPlace {
    path: KeyPath,
    key: Range<usize>,
    value: Range<usize>,
}

impl Items {
    fn of(text: &str) -> Option<Self> {
        let table = DeTable::parse(text).ok()?;
        let (mut keys, mut strings) = (Vec::new(), Vec::new());
        collect(table.get_ref(), &[], &mut keys, &mut strings);
        keys.sort_by_key(|place| place.key.start);
        // Only strings of several lines contain the beginning of a line.
        strings.retain(|string| text[string.clone()].contains('\n'));
        let ends: Vec<usize> = text.match_indices('\n').map(|(end, _)| end).collect();
        let line_of = |position: usize| ends.partition_point(|end| *end < position);
        let mut by_line: BTreeMap<usize, Item> = BTreeMap::new();
        for place in keys {
            let line = line_of(place.key.start);
            let line_start = text[..place.key.start].rfind('\n').map_or(0, |end| end + 1);
            let before_key = text[line_start..place.key.start].trim_start();
            let is_header = before_key.starts_with('[');
            // The names before the sign of equality are the path of the item, and those after it are
            // in an inline table.
            if !is_header && before_key.contains('=') {
                continue;
            }
            let end = if is_header {
                place.key.end
            } else {
                place.value.end
            };
            let item = Item {
                path: place.path,
                line,
                last_line: line_of(end),
                end,
                is_header,
            };
            by_line.insert(line, item);
        }
        Some(Self { by_line, strings })
    }
}

fn collect(
    table: &DeTable<'_>,
    parents: &[String],
    keys: &mut Vec<KeyPlace>,
    strings: &mut Vec<Range<usize>>,
) {
    for (key, value) in table {
        let mut path = parents.to_vec();
        path.push(key.get_ref().to_string());
        match value.get_ref() {
            DeValue::Table(inner) => collect(inner, &path, keys, strings),
            DeValue::String(_) => strings.push(value.span()),
            _ => {}
        }
        keys.push(KeyPlace {
            path,
            key: key.span(),
            value: value.span(),
        });
    }
}

/// The comment at the end of the line of an item.
fn beside<'a>(text: &'a str, item: &Item) -> Option<&'a str> {
    let rest = text[item.end..].lines().next()?;
    let rest = if item.is_header {
        rest.split_once(']')?.1
    } else {
        rest
    };
    let rest = rest.trim();
    rest.starts_with('#').then_some(rest)
}

/// The value at a path.
fn at<'a>(table: &'a Table, path: &[String]) -> Option<&'a Value> {
    let (first, rest) = path.split_first()?;
    let value = table.get(first)?;
    match value {
        _ if rest.is_empty() => Some(value),
        Value::Table(inner) => at(inner, rest),
        _ => None,
    }
}

/// Whether a number of a value has changed. Texts change without a measurement, such as paths.
fn is_changed(old: Option<&Value>, new: Option<&Value>) -> bool {
    match (old, new) {
        (Some(Value::Table(old)), Some(Value::Table(new))) => old
            .iter()
            .any(|(key, value)| is_changed(Some(value), new.get(key))),
        (Some(Value::Array(old)), Some(Value::Array(new))) => {
            old.len() != new.len()
                || std::iter::zip(old, new).any(|(old, new)| is_changed(Some(old), Some(new)))
        }
        (Some(old), Some(new)) => match (number(old), number(new)) {
            (Some(old), Some(new)) => (old - new).abs() > TOLERANCE * (1.0 + old.abs()),
            (None, None) => false,
            _ => true,
        },
        (Some(_), None) => true,
        (None, _) => false,
    }
}

fn number(value: &Value) -> Option<f64> {
    match value {
        Value::Float(number) => Some(*number),
        #[expect(
            clippy::cast_precision_loss,
            reason = "rig files have no integers near 2^53"
        )]
        Value::Integer(number) => Some(*number as f64),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OLD: &str = "\
# Rig of the lab.
# All keys are in the reference.

[arm] # on the table
# Guess: the robot is a UR5e.
urdf = \"builtin:ur5e\"
driver = \"sim\" # until the real one arrives

# [arm.motion]
# on_loss = \"hold\"
[camera.wrist]
# Do not change: the mount is glued.
# Guess: the pose of a drawing.
parent_from_camera = { xyz_m = [0, 0.5, 0.1] }
# Guess: a lens of 65 degrees.
intrinsics = { focal_px = [600, 600] }
# The name of a removed key.
v4l2.gain = 3
text = \"\"\"
# no comment
\"\"\"
# The end.
";
    const NEW: &str = "\
[arm]
driver = \"sim\"
urdf = \"robot.urdf\"

[camera.wrist]
text = \"\"\"
# no comment
\"\"\"

[camera.wrist.intrinsics]
focal_px = [612.5, 613.0]

[camera.wrist.parent_from_camera]
xyz_m = [0.0, 0.5, 0.1]
";

    #[test]
    fn comments_stay_with_their_keys() {
        let text = carried(OLD, NEW).expect("both are TOML");
        assert_eq!(
            text,
            "\
# Rig of the lab.
# All keys are in the reference.

[arm] # on the table
driver = \"sim\" # until the real one arrives
# Guess: the robot is a UR5e.
urdf = \"robot.urdf\"

# [arm.motion]
# on_loss = \"hold\"
# The name of a removed key.
[camera.wrist]
text = \"\"\"
# no comment
\"\"\"

[camera.wrist.intrinsics]
focal_px = [612.5, 613.0]

# Do not change: the mount is glued.
# Guess: the pose of a drawing.
[camera.wrist.parent_from_camera]
xyz_m = [0.0, 0.5, 0.1]
# The end.
"
        );
    }

    #[test]
    fn carrying_comments_twice_changes_nothing() {
        let once = carried(OLD, NEW).expect("both are TOML");
        assert_eq!(carried(&once, NEW).as_deref(), Some(&*once));
        assert_eq!(carried("", NEW).as_deref(), Some(NEW));
        assert_eq!(carried(NEW, NEW).as_deref(), Some(NEW));
    }

    #[test]
    fn texts_that_are_not_toml_have_no_comments() {
        assert_eq!(carried("[arm", NEW), None);
        assert_eq!(carried(OLD, "[arm"), None);
    }

    #[test]
    fn only_measured_numbers_end_a_guess() {
        let value = |text: &str| -> Value {
            let table: Table = toml::from_str(&format!("value = {text}")).expect(text);
            table["value"].clone()
        };
        for (old, new, expected) in [
            ("3", "3.0", false),
            ("[0, 0.70711]", "[0.0, 0.7071068]", false),
            ("[600, 600]", "[612.5, 600]", true),
            ("\"builtin:ur5e\"", "\"robot.urdf\"", false),
            ("{ a = 1 }", "{ a = 1, b = 2 }", false),
            ("{ a = 1 }", "{ b = 1 }", true),
        ] {
            let changed = is_changed(Some(&value(old)), Some(&value(new)));
            assert_eq!(changed, expected, "{old} {new}");
        }
    }
}
