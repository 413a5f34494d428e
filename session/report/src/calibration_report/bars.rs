//! Tables whose numbers have bars behind them.

use super::number;
use crate::chart::drawing::escaped;

/// A column: its header and the number of decimals.
pub(super) type Column = (&'static str, usize);

/// A row of a table with bars.
pub(super) struct BarRow {
    pub(super) name: String,
    /// Tag of the row, such as `outlier`. It may be empty.
    pub(super) tag: String,
    /// One value per column.
    pub(super) values: Vec<Option<f64>>,
}

/// A table with one bar per value, relative to the largest value of the column in rows without a
/// tag. Columns without values are left out.
pub(super) fn table(head: &str, columns: &[Column], rows: &[BarRow]) -> String {
    /// Longer tables are scrolled.
    const MAX_ROWS: usize = 30;
    if rows.is_empty() {
        return String::new();
    }
    let shown: Vec<ShownColumn> = columns
        .iter()
        .enumerate()
        .filter(|(ix, _)| rows.iter().any(|row| row.value(*ix).is_some()))
        .map(|(ix, &(name, digits))| ShownColumn {
            ix,
            name,
            digits,
            largest: largest(rows, ix),
        })
        .collect();
    let names: String = shown
        .iter()
        .map(|column| format!("<th>{}</th>", escaped(column.name)))
        .collect();
    let class = if rows.len() > MAX_ROWS {
        "wide long"
    } else {
        "wide"
    };
    format!(
        "<div class=\"{class}\"><table class=\"bars\">\n<thead><tr><th>{}</th>{names}</tr></thead>\n<tbody>{}</tbody></table></div>",
        escaped(head),
        rows.iter().map(|row| row.html(&shown)).collect::<String>()
    )
}

/// A column that has values.
struct ShownColumn {
    /// Index of the column among the values of a row.
    ix: usize,
    name: &'static str,
    digits: usize,
    /// The largest value of the column, whose bar has the full length.
    largest: f64,
}

/// Largest value of a column in rows without a tag. If all rows have a tag, it is the largest value
/// of all rows.
fn largest(rows: &[BarRow], ix: usize) -> f64 {
    // An outlier may be hundreds of times larger than the other values. If outliers determined the
    // scale, the bars of the other values would disappear.
    let used = largest_of(rows.iter().filter(|row| row.tag.is_empty()), ix);
    if used > 0.0 {
        used
    } else {
        largest_of(rows.iter(), ix)
    }
}

/// Largest finite value of a column. It is 0 if there is none.
fn largest_of<'a>(rows: impl Iterator<Item = &'a BarRow>, ix: usize) -> f64 {
    rows.filter_map(|row| row.value(ix))
        .filter(|value| value.is_finite())
        .fold(0.0, f64::max)
}

impl BarRow {
    fn value(&self, ix: usize) -> Option<f64> {
        self.values.get(ix).copied().flatten()
    }

    fn html(&self, columns: &[ShownColumn]) -> String {
        let cells = columns.iter().map(|column| {
            let value = self.value(column.ix);
            let percent = value.map_or(0.0, |value| {
                (100.0 * value / column.largest).clamp(0.0, 100.0)
            });
            // 0 / 0 is a NaN, which CSS would reject.
            let percent = if percent.is_finite() { percent } else { 0.0 };
            format!(
                "<td class=\"bar\" style=\"--part:{percent:.1}%\">{}</td>",
                number(value, column.digits)
            )
        });
        let (class, tag) = if self.tag.is_empty() {
            ("", String::new())
        } else {
            let tag = format!(" <span class=\"tag\">{}</span>", escaped(&self.tag));
            (" class=\"unused\"", tag)
        };
        format!(
            "<tr{class}><td>{}{tag}</td>{}</tr>\n",
            escaped(&self.name),
            cells.collect::<String>()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_are_relative_to_used_rows() {
        let row = |name: &str, tag: &str, value: f64| BarRow {
            name: name.to_owned(),
            tag: tag.to_owned(),
            values: vec![Some(value), None],
        };
        let rows = [
            row("a", "", 2.0),
            row("<b>", "", 1.0),
            row("c", "outlier", 50.0),
            row("d", "", f64::INFINITY),
        ];
        let html = table("image", &[("px", 2), ("mm", 1)], &rows);
        for expected in [
            "--part:100.0%\">2.00",
            "--part:50.0%\">1.00",
            "&lt;b&gt;",
            "<span class=\"tag\">outlier",
        ] {
            assert!(html.contains(expected), "{expected}: {html}");
        }
        assert!(
            !html.contains("mm") && !html.contains("<b>") && !html.contains("inf"),
            "{html}"
        );
        assert_eq!(table("image", &[("px", 2)], &[]), "");
    }
}
