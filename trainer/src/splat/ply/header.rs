//! The header and tables of a binary `.ply` file. Source: Turk, "The PLY Polygon File Format", 1994.

/// Maximum length of a header. Headers of splat files have about 2000 bytes.
const MAX_HEADER_BYTES: usize = 64 * 1024;

/// The tables of a file.
pub(super) struct Header {
    elements: Vec<Element>,
}

/// One table: `count` rows of `properties`, starting at byte `start` of the file.
struct Element {
    name: String,
    count: usize,
    start: usize,
    row_bytes: usize,
    properties: Vec<Property>,
}

struct Property {
    name: String,
    number_type: NumberType,
    offset: usize,
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
}

impl Header {
    /// Parses the header and checks that its tables fit into the file.
    pub(super) fn parse(bytes: &[u8]) -> Result<Self, String> {
        const END: &[u8] = b"end_header\n";
        let searched = &bytes[..bytes.len().min(MAX_HEADER_BYTES)];
        let end = searched.windows(END.len()).position(|window| window == END);
        let end = end.ok_or("no PLY header with Unix line endings")?;
        let text = std::str::from_utf8(&bytes[..end]).map_err(|_| "the header is not UTF-8")?;
        let mut header = Self { elements: Vec::new() };
        let mut lines = text.lines();
        if lines.next() != Some("ply") {
            return Err("the header does not begin with \"ply\"".to_owned());
        }
        for line in lines {
            header.parse_line(line)?;
        }
        header.locate_tables(end + END.len(), bytes.len())?;
        Ok(header)
    }

    pub(super) fn has_element(&self, name: &str) -> bool {
        self.elements.iter().any(|element| element.name == name)
    }

    /// The table of this name.
    pub(super) fn table<'a>(&'a self, name: &str, bytes: &'a [u8]) -> Result<Table<'a>, String> {
        let element = self.elements.iter().find(|element| element.name == name);
        let element = element.ok_or_else(|| format!("element {name:?} is missing"))?;
        Ok(Table { element, rows: &bytes[element.start..element.start + element.count * element.row_bytes] })
    }

    fn parse_line(&mut self, line: &str) -> Result<(), String> {
        let words: Vec<&str> = line.split_whitespace().collect();
        match (words.as_slice(), self.elements.last_mut()) {
            ([] | ["comment" | "obj_info", ..] | ["format", "binary_little_endian", "1.0"], _) => Ok(()),
            (["format", other, ..], _) => Err(format!("format {other}, expected binary_little_endian 1.0")),
            (["element", name, count], _) => {
                let count = count.parse().map_err(|_| format!("element {name}: count {count:?} is not a number"))?;
                let name = (*name).to_owned();
                self.elements.push(Element { name, count, start: 0, row_bytes: 0, properties: Vec::new() });
                Ok(())
            }
            (["property", word, name], Some(element)) => {
                let number_type =
                    NumberType::of(word).ok_or_else(|| format!("property {name}: unknown type {word:?}"))?;
                element.properties.push(Property { name: (*name).to_owned(), number_type, offset: element.row_bytes });
                element.row_bytes += number_type.bytes();
                Ok(())
            }
            _ => Err(format!("unknown header line {line:?}")),
        }
    }

    fn locate_tables(&mut self, mut start: usize, file_bytes: usize) -> Result<(), String> {
        for element in &mut self.elements {
            element.start = start;
            let end = element.count.checked_mul(element.row_bytes).and_then(|bytes| bytes.checked_add(start));
            match end {
                Some(end) if end <= file_bytes => start = end,
                _ => return Err(format!("truncated: fewer than {} rows of {:?}", element.count, element.name)),
            }
        }
        Ok(())
    }
}

/// One table of a file.
pub(super) struct Table<'a> {
    element: &'a Element,
    rows: &'a [u8],
}

impl<'a> Table<'a> {
    pub(super) fn n_rows(&self) -> usize {
        self.element.count
    }

    pub(super) fn column(&self, name: &str) -> Result<Column<'a>, String> {
        let property = self.element.properties.iter().find(|property| property.name == name);
        let property = property.ok_or_else(|| format!("element {:?} has no property {name:?}", self.element.name))?;
        Ok(Column { property, row_bytes: self.element.row_bytes, rows: self.rows })
    }

    pub(super) fn columns<const N: usize>(&self, names: [&str; N]) -> Result<[Column<'a>; N], String> {
        let columns: Result<Vec<_>, _> = names.into_iter().map(|name| self.column(name)).collect();
        columns.map(|columns| columns.try_into().unwrap_or_else(|_| unreachable!("as many columns as names")))
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

    /// The value as packed bits. Fails if the property is not an unsigned 32-bit integer.
    pub(super) fn bits(&self, row: usize) -> Result<u32, String> {
        match self.property.number_type {
            NumberType::U32 => Ok(u32::from_le_bytes(self.bytes(row))),
            other => Err(format!("property {:?} has type {other:?}, expected uint", self.property.name)),
        }
    }

    fn bytes<const N: usize>(&self, row: usize) -> [u8; N] {
        let start = row * self.row_bytes + self.property.offset;
        self.rows[start..start + N].try_into().expect("the slice has this length")
    }
}
