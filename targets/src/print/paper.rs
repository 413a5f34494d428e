//! Paper sizes.

use crate::error::PrintError;
use std::fmt;
use std::str::FromStr;

/// A paper size. Printing chooses portrait or landscape.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Paper {
    /// The shorter and the longer side of a named size, or the given width and height, millimeters.
    size_mm: [f64; 2],
}

/// Named sizes, ISO 216 and ANSI, millimeters.
const NAMED: [(&str, [f64; 2]); 7] = [
    ("a4", [210.0, 297.0]),
    ("letter", [215.9, 279.4]),
    ("a3", [297.0, 420.0]),
    ("a2", [420.0, 594.0]),
    ("a1", [594.0, 841.0]),
    ("a0", [841.0, 1189.0]),
    ("2a0", [1189.0, 1682.0]),
];
/// Smallest and largest side of papers without a name, millimeters. If a side is outside this
/// range, its unit is probably wrong.
const SIDE_MM: [f64; 2] = [50.0, 5000.0];

impl Paper {
    /// ISO A4.
    pub const A4: Self = Self {
        size_mm: NAMED[0].1,
    };

    /// Width and height, millimeters.
    pub fn size_mm(&self) -> [f64; 2] {
        self.size_mm
    }

    /// The same paper, rotated by 90 degrees.
    pub(super) fn rotated(self) -> Self {
        Self {
            size_mm: [self.size_mm[1], self.size_mm[0]],
        }
    }

    /// The smallest named paper into which a rectangle fits. If no named paper is large enough, the
    /// result is a paper of about the size of the rectangle.
    pub(super) fn for_size(need_mm: [f64; 2]) -> Self {
        let fits = |[width, height]: [f64; 2]| need_mm[0] <= width && need_mm[1] <= height;
        let named = NAMED
            .into_iter()
            .map(|(_, size_mm)| size_mm)
            .find(|&[width, height]| fits([width, height]) || fits([height, width]));
        Self {
            // The size is rounded up to centimeters, so that a print shop can be asked for it.
            size_mm: named.unwrap_or_else(|| need_mm.map(|value| (value / 10.0).ceil() * 10.0)),
        }
    }
}

impl Default for Paper {
    fn default() -> Self {
        Self::A4
    }
}

impl FromStr for Paper {
    type Err = PrintError;

    fn from_str(text: &str) -> Result<Self, PrintError> {
        let value = text.trim().to_ascii_lowercase();
        if let Some((_, size_mm)) = NAMED.into_iter().find(|(name, _)| *name == value) {
            return Ok(Self { size_mm });
        }
        let size_mm = parse_size_mm(&value).ok_or_else(|| PrintError::Paper {
            value: text.to_owned(),
        })?;
        Ok(Self { size_mm })
    }
}

/// Parses a size such as `600x400mm`.
fn parse_size_mm(value: &str) -> Option<[f64; 2]> {
    let (width, height) = value.strip_suffix("mm")?.split_once('x')?;
    let size_mm = [
        width.trim().parse::<f64>().ok()?,
        height.trim().parse::<f64>().ok()?,
    ];
    size_mm
        .iter()
        .all(|side| (SIDE_MM[0]..=SIDE_MM[1]).contains(side))
        .then_some(size_mm)
}

impl fmt::Display for Paper {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match NAMED
            .into_iter()
            .find(|(_, size_mm)| *size_mm == self.size_mm || *size_mm == self.rotated().size_mm)
        {
            Some((name, _)) => f.write_str(name),
            None => write!(f, "{}x{}mm", self.size_mm[0], self.size_mm[1]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_sizes_are_parsed() {
        assert_eq!("A3".parse::<Paper>().unwrap().size_mm(), [297.0, 420.0]);
        assert_eq!(
            "600x400mm".parse::<Paper>().unwrap().to_string(),
            "600x400mm"
        );
        assert_eq!("letter".parse::<Paper>().unwrap().to_string(), "letter");
        for wrong in [
            "",
            "a9",
            "600x400",
            "0x400mm",
            "NaNx400mm",
            "600mm",
            "9000x400mm",
        ] {
            assert!(
                wrong
                    .parse::<Paper>()
                    .unwrap_err()
                    .to_string()
                    .contains("unknown paper"),
                "{wrong}"
            );
        }
        assert_eq!(Paper::for_size([400.0, 290.0]).to_string(), "a3");
        assert_eq!(Paper::for_size([4001.0, 290.0]).to_string(), "4010x290mm");
    }
}
