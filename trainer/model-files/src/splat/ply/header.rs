//! The header and tables of a `.ply` file. Source: Turk, "The PLY Polygon File Format", 1994.

use std::borrow::Cow;

/// Maximum length of a header. Headers of splat files have about 2000 bytes. The limit bounds the
/// search for the end of the header in files without such an end.
const MAX_HEADER_BYTES: usize = 64 * 1024;

/// The tables of a file.
pub(super) struct Header<'a> {
    elements: Vec<Element<'a>>,
    comments: Vec<String>,
    /// Number of bytes after the last row.
    n_unread: usize,
}

/// One table: `count` rows of `properties`.
struct Element<'a> {
    name: String,
    count: usize,
    row_bytes: usize,
    /// The properties that are not lists.
    properties: Vec<Property>,
    /// The list properties, such as the corners of a face. They are skipped.
    lists: Vec<List>,
    /// The little-endian rows, or an error if they are not in the file.
    rows: Result<Cow<'a, [u8]>, String>,
}

struct Property {
    name: String,
    number_type: NumberType,
    offset: usize,
}

/// A list property. It consists of a length, followed by this number of numbers.
struct List {
    length: NumberType,
    number: NumberType,
    /// Number of the properties before the list that are not lists. The next field is their size.
    n_before: usize,
    bytes_before: usize,
}

/// How numbers are stored.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Format {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// Type of a stored number.
#[derive(Clone, Copy, Debug)]
enum NumberType {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl NumberType {
    fn of(word: &str) -> Option<Self> {
        Some(match word {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The little-endian bytes of a number in text form. `None` if it is not a number of this type.
    fn little_endian(self, word: &str) -> Option<Vec<u8>> {
        Some(match self {
            Self::I8 => word.parse::<i8>().ok()?.to_le_bytes().to_vec(),
            Self::U8 => word.parse::<u8>().ok()?.to_le_bytes().to_vec(),
            Self::I16 => word.parse::<i16>().ok()?.to_le_bytes().to_vec(),
            Self::U16 => word.parse::<u16>().ok()?.to_le_bytes().to_vec(),
            Self::I32 => word.parse::<i32>().ok()?.to_le_bytes().to_vec(),
            Self::U32 => word.parse::<u32>().ok()?.to_le_bytes().to_vec(),
            Self::F32 => word.parse::<f32>().ok()?.to_le_bytes().to_vec(),
            Self::F64 => word.parse::<f64>().ok()?.to_le_bytes().to_vec(),
        })
    }

    /// Decodes little-endian bytes as the length of a list. `None` for negative numbers and floats.
    fn length(self, bytes: &[u8]) -> Option<usize> {
        match self {
            Self::U8 => Some(usize::from(*bytes.first()?)),
            Self::U16 => Some(usize::from(u16::from_le_bytes(*bytes.first_chunk()?))),
            Self::U32 => usize::try_from(u32::from_le_bytes(*bytes.first_chunk()?)).ok(),
            Self::I8 => usize::try_from(i8::from_le_bytes(*bytes.first_chunk()?)).ok(),
            Self::I16 => usize::try_from(i16::from_le_bytes(*bytes.first_chunk()?)).ok(),
            Self::I32 => usize::try_from(i32::from_le_bytes(*bytes.first_chunk()?)).ok(),
            Self::F32 | Self::F64 => None,
        }
    }
}

impl<'a> Header<'a> {
    /// Parses the header and finds the tables.
    pub(super) fn parse(bytes: &'a [u8]) -> Result<Self, String> {
        // Binary rows follow directly, so the header cannot be split into lines before its end is
        // known.
        let searched = &bytes[..bytes.len().min(MAX_HEADER_BYTES)];
        let end = [&b"\nend_header\n"[..], b"\nend_header\r\n"]
            .into_iter()
            .find_map(|end| {
                let at = searched
                    .windows(end.len())
                    .position(|window| window == end)?;
                Some((at, at + end.len()))
            });
        let (end, start) = end.ok_or("it has no PLY header")?;
        let text = std::str::from_utf8(&bytes[..end]).map_err(|_| "the header is not UTF-8")?;
        let mut header = Self {
            elements: Vec::new(),
            comments: Vec::new(),
            n_unread: 0,
        };
        let mut lines = text.lines().map(|line| line.trim_end_matches('\r'));
        if lines.next() != Some("ply") {
            return Err("the header does not begin with \"ply\"".to_owned());
        }
        let mut format = None;
        for line in lines {
            header.parse_line(line, &mut format)?;
        }
        match format.ok_or("the header has no line \"format\"")? {
            Format::Ascii => header.read_ascii(&bytes[start..]),
            format => header.locate_binary(&bytes[start..], format),
        }
        Ok(header)
    }

    pub(super) fn has_element(&self, name: &str) -> bool {
        self.elements.iter().any(|element| element.name == name)
    }

    /// Number of bytes after the last row.
    pub(super) fn n_unread(&self) -> usize {
        self.n_unread
    }

    /// The texts of the comments.
    pub(super) fn comments(&self) -> &[String] {
        &self.comments
    }

    /// The table of this name.
    pub(super) fn table(&self, name: &str) -> Result<Table<'_>, String> {
        let element = self.elements.iter().find(|element| element.name == name);
        let element = element.ok_or_else(|| format!("element {name:?} is missing"))?;
        if !element.lists.is_empty() {
            return Err(format!("element {name:?} has a list, expected numbers"));
        }
        Ok(Table {
            element,
            rows: element.rows.as_ref().map_err(Clone::clone)?,
        })
    }

    fn parse_line(&mut self, line: &str, format: &mut Option<Format>) -> Result<(), String> {
        // A property belongs to the last element before it.
        let words: Vec<&str> = line.split_whitespace().collect();
        match (words.as_slice(), self.elements.last_mut()) {
            ([] | ["obj_info", ..], _) => {}
            (["comment", ..], _) => self.comments.push(words[1..].join(" ")),
            (["format", name, "1.0"], _) => {
                *format = Some(match *name {
                    "ascii" => Format::Ascii,
                    "binary_little_endian" => Format::LittleEndian,
                    "binary_big_endian" => Format::BigEndian,
                    other => return Err(format!("unknown format {other:?}")),
                });
            }
            (["element", name, count], _) => {
                let count = count
                    .parse()
                    .map_err(|_| format!("element {name}: count {count:?} is not a number"))?;
                self.elements.push(Element {
                    name: (*name).to_owned(),
                    count,
                    row_bytes: 0,
                    properties: Vec::new(),
                    lists: Vec::new(),
                    // Replaced when the rows are found.
                    rows: Err("it is not in the file".to_owned()),
                });
            }
            (["property", "list", length, word, name], Some(element)) => {
                let types = [length, word].map(|word| NumberType::of(word));
                let [Some(length), Some(number)] = types else {
                    return Err(format!("property {name}: unknown type in {line:?}"));
                };
                element.lists.push(List {
                    length,
                    number,
                    n_before: element.properties.len(),
                    bytes_before: element.row_bytes,
                });
            }
            (["property", word, name], Some(element)) => {
                let number_type = NumberType::of(word)
                    .ok_or_else(|| format!("property {name}: unknown type {word:?}"))?;
                // If a name occurs twice, it is not clear which property is meant.
                if element
                    .properties
                    .iter()
                    .any(|property| property.name == *name)
                {
                    return Err(format!("element {}: two properties {name:?}", element.name));
                }
                element.properties.push(Property {
                    name: (*name).to_owned(),
                    number_type,
                    offset: element.row_bytes,
                });
                element.row_bytes += number_type.bytes();
            }
            _ => return Err(format!("unknown header line {line:?}")),
        }
        Ok(())
    }

    /// Finds the rows of each element up to the first incomplete element. Later elements keep their
    /// error.
    fn locate_binary(&mut self, mut rest: &'a [u8], format: Format) {
        for element in &mut self.elements {
            // The product is checked for overflow, because the count comes from the file and may be
            // any number.
            let n_bytes = if element.lists.is_empty() {
                element.count.checked_mul(element.row_bytes)
            } else {
                bytes_with_lists(element, rest, format)
            };
            let Some((rows, after)) = n_bytes.and_then(|n_bytes| rest.split_at_checked(n_bytes))
            else {
                element.rows = Err(truncated(element));
                return;
            };
            rest = after;
            // The numbers of tables with lists are not used, so their bytes need no swapping.
            element.rows = Ok(match format {
                Format::BigEndian if element.lists.is_empty() => swapped(element, rows).into(),
                _ => rows.into(),
            });
        }
        self.n_unread = rest.len();
    }

    /// Converts the rows of each element to binary.
    fn read_ascii(&mut self, text: &[u8]) {
        let mut lines = text
            .split(|byte| *byte == b'\n')
            .filter(|line| !line.trim_ascii().is_empty());
        for element in &mut self.elements {
            // A number and a space take at least two bytes. A larger count must not reserve memory.
            let n_words = element
                .count
                .checked_mul(element.properties.len() + element.lists.len());
            if n_words.is_none_or(|n_words| n_words > text.len().div_ceil(2)) {
                element.rows = Err(truncated(element));
                return;
            }
            let mut rows = Vec::with_capacity(element.count * element.row_bytes);
            let problem = (0..element.count).find_map(|row| {
                match lines.next().and_then(|line| std::str::from_utf8(line).ok()) {
                    Some(line) => read_row(element, line, &mut rows)
                        .err()
                        .map(|reason| format!("row {row} of {:?}: {reason}", element.name)),
                    None => Some(truncated(element)),
                }
            });
            // The start of later elements is unknown, so they keep their error.
            if let Some(problem) = problem {
                element.rows = Err(problem);
                return;
            }
            element.rows = Ok(rows.into());
        }
        self.n_unread = lines.map(<[u8]>::len).sum();
    }
}

/// Appends the numbers of a row of text to `rows`, little-endian.
fn read_row(element: &Element<'_>, line: &str, rows: &mut Vec<u8>) -> Result<(), String> {
    let mut words = line.split_ascii_whitespace();
    let n_expected = element.properties.len();
    let wrong = || format!("it does not have {n_expected} numbers");
    for (property_ix, property) in element.properties.iter().enumerate() {
        skip_lists(&element.lists, property_ix, &mut words).ok_or_else(wrong)?;
        let word = words.next().ok_or_else(wrong)?;
        let bytes = property.number_type.little_endian(word).ok_or_else(|| {
            // The word comes from the file and may be long.
            let shown: String = word.chars().take(30).collect();
            format!(
                "{}: {shown:?} is not a valid {:?}",
                property.name, property.number_type
            )
        })?;
        rows.extend(bytes);
    }
    skip_lists(&element.lists, n_expected, &mut words).ok_or_else(wrong)?;
    // More words than properties mean that the header does not describe the row.
    words.next().map_or(Ok(()), |_| Err(wrong()))
}

fn truncated(element: &Element<'_>) -> String {
    format!(
        "truncated: fewer than {} rows of {:?}",
        element.count, element.name
    )
}

/// Skips the lists that follow the given number of other properties in a row of text. `None` if the
/// lists are not complete.
fn skip_lists<'a>(
    lists: &[List],
    n_before: usize,
    words: &mut impl Iterator<Item = &'a str>,
) -> Option<()> {
    for _ in lists.iter().filter(|list| list.n_before == n_before) {
        let length: usize = words.next()?.parse().ok()?;
        for _ in 0..length {
            words.next()?;
        }
    }
    Some(())
}

/// Size of the rows of an element with lists. `None` if the rows are not complete.
fn bytes_with_lists(element: &Element<'_>, bytes: &[u8], format: Format) -> Option<usize> {
    // Lengths come from the file, so every sum is checked. A loop over a large count ends early,
    // because each row takes at least one byte of the file.
    let mut at = 0_usize;
    for _ in 0..element.count {
        let mut n_passed_bytes = 0;
        for list in &element.lists {
            at = at.checked_add(list.bytes_before - n_passed_bytes)?;
            n_passed_bytes = list.bytes_before;
            let mut length = bytes
                .get(at..at.checked_add(list.length.bytes())?)?
                .to_vec();
            if format == Format::BigEndian {
                length.reverse();
            }
            let n_number_bytes = list
                .length
                .length(&length)?
                .checked_mul(list.number.bytes())?;
            at = at
                .checked_add(list.length.bytes())?
                .checked_add(n_number_bytes)?;
        }
        at = at.checked_add(element.row_bytes - n_passed_bytes)?;
    }
    Some(at)
}

/// The rows with the bytes of each number in reverse order.
fn swapped(element: &Element<'_>, rows: &[u8]) -> Vec<u8> {
    let mut rows = rows.to_vec();
    for row in rows.chunks_exact_mut(element.row_bytes.max(1)) {
        for property in &element.properties {
            row[property.offset..property.offset + property.number_type.bytes()].reverse();
        }
    }
    rows
}

/// One table of a file.
pub(super) struct Table<'a> {
    element: &'a Element<'a>,
    rows: &'a [u8],
}

impl<'a> Table<'a> {
    pub(super) fn n_rows(&self) -> usize {
        self.element.count
    }

    /// Names of the properties.
    pub(super) fn names(&self) -> impl Iterator<Item = &'a str> {
        self.element
            .properties
            .iter()
            .map(|property| property.name.as_str())
    }

    pub(super) fn column(&self, name: &str) -> Result<Column<'a>, String> {
        let property = self
            .element
            .properties
            .iter()
            .find(|property| property.name == name);
        let property = property
            .ok_or_else(|| format!("element {:?} has no property {name:?}", self.element.name))?;
        Ok(Column {
            property,
            row_bytes: self.element.row_bytes,
            rows: self.rows,
        })
    }

    pub(super) fn columns<const N: usize>(
        &self,
        names: [&str; N],
    ) -> Result<[Column<'a>; N], String> {
        let columns: Result<Vec<_>, _> = names.into_iter().map(|name| self.column(name)).collect();
        columns.map(|columns| {
            columns
                .try_into()
                .unwrap_or_else(|_| unreachable!("as many columns as names"))
        })
    }
}

/// One property of all rows.
pub(super) struct Column<'a> {
    property: &'a Property,
    row_bytes: usize,
    rows: &'a [u8],
}

impl Column<'_> {
    /// The value as f32.
    #[expect(clippy::cast_possible_truncation, reason = "splats are always f32")]
    pub(super) fn f32(&self, row: usize) -> f32 {
        match self.property.number_type {
            NumberType::I8 => f32::from(i8::from_le_bytes(self.bytes(row))),
            NumberType::U8 => f32::from(u8::from_le_bytes(self.bytes(row))),
            NumberType::I16 => f32::from(i16::from_le_bytes(self.bytes(row))),
            NumberType::U16 => f32::from(u16::from_le_bytes(self.bytes(row))),
            NumberType::I32 => i32::from_le_bytes(self.bytes(row)) as f32,
            NumberType::U32 => u32::from_le_bytes(self.bytes(row)) as f32,
            NumberType::F32 => f32::from_le_bytes(self.bytes(row)),
            NumberType::F64 => f64::from_le_bytes(self.bytes(row)) as f32,
        }
    }

    /// The value as a color channel from 0 to 1. Integers are divided by their maximum.
    pub(super) fn channel(&self, row: usize) -> f32 {
        let max = match self.property.number_type {
            NumberType::U8 => f32::from(u8::MAX),
            NumberType::U16 => f32::from(u16::MAX),
            _ => 1.0,
        };
        self.f32(row) / max
    }

    /// The value as packed bits. Fails if the property is not an unsigned 32-bit integer.
    pub(super) fn bits(&self, row: usize) -> Result<u32, String> {
        match self.property.number_type {
            NumberType::U32 => Ok(u32::from_le_bytes(self.bytes(row))),
            other => Err(format!(
                "property {:?} has type {other:?}, expected uint",
                self.property.name
            )),
        }
    }

    fn bytes<const N: usize>(&self, row: usize) -> [u8; N] {
        let start = row * self.row_bytes + self.property.offset;
        self.rows[start..start + N]
            .try_into()
            .expect("the slice has this length")
    }
}
