//! Tables whose numbers have bars behind them.

use super::number;
use crate::chart::drawing::escaped;

/// A column: its header and the number of decimals.
pub(super) type Column = (&'static str, usize);

/// A row of a table with bars.
pub(super) struct BarRow {
    pub(super) name: String,
    /// Tag of the row, such as `outlier`; may be empty.
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
    let value = |row: &BarRow, ix: usize| row.values.get(ix).copied().flatten();
    let shown: Vec<(usize, &Column)> = columns
        .iter()
        .enumerate()
        .filter(|(ix, _)| rows.iter().any(|row| value(row, *ix).is_some()))
        .collect();
    let largest = |ix: usize| {
        let of = |all: bool| {
            let values = rows
                .iter()
                .filter(|row| all || row.tag.is_empty())
                .filter_map(|row| value(row, ix));
            values.filter(|value| value.is_finite()).fold(0.0, f64::max)
        };
        if of(false) > 0.0 { of(false) } else { of(true) }
    };
    let largest: Vec<f64> = shown.iter().map(|(ix, _)| largest(*ix)).collect();
    let row = |row: &BarRow| {
        let cells = shown
            .iter()
            .zip(&largest)
            .map(|((ix, (_, digits)), largest)| {
                let value = value(row, *ix);
                let percent =
                    value.map_or(0.0, |value| (100.0 * value / largest).clamp(0.0, 100.0));
                let percent = if percent.is_finite() { percent } else { 0.0 };
                format!(
                    "<td class=\"bar\" style=\"--part:{percent:.1}%\">{}</td>",
                    number(value, *digits)
                )
            });
        let tag = match row.tag.is_empty() {
            true => String::new(),
            false => format!(" <span class=\"tag\">{}</span>", escaped(&row.tag)),
        };
        let class = if row.tag.is_empty() {
            ""
        } else {
            " class=\"unused\""
        };
        format!(
            "<tr{class}><td>{}{tag}</td>{}</tr>\n",
            escaped(&row.name),
            cells.collect::<String>()
        )
    };
    let names: String = shown
        .iter()
        .map(|(_, (name, _))| format!("<th>{}</th>", escaped(name)))
        .collect();
    let class = if rows.len() > MAX_ROWS {
        "wide long"
    } else {
        "wide"
    };
    format!(
        "<div class=\"{class}\"><table class=\"bars\">\n<thead><tr><th>{}</th>{names}</tr></thead>\n<tbody>{}</tbody></table></div>",
        escaped(head),
        rows.iter().map(row).collect::<String>()
    )
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
