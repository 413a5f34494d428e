//! Tables of text, for pages and terminals.

use crate::chart::drawing::escaped;

/// A table of text. The first column contains the row headers.
pub struct Table {
    /// Title above the table.
    pub title: String,
    /// Names of the columns.
    pub head: Vec<String>,
    /// Cells of each row.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// The table with its title as HTML.
    pub fn html(&self) -> String {
        let title = escaped(&self.title);
        let head = html_row(&self.head, "th");
        let rows: String = self
            .rows
            .iter()
            .map(|cells| html_row(cells, "td"))
            .collect();
        format!(
            "<h2>{title}</h2>\n<div class=\"wide\"><table>\n<thead>{head}</thead>\n<tbody>{rows}</tbody></table></div>\n"
        )
    }

    /// The table with aligned columns, for a terminal.
    pub fn text(&self) -> String {
        let all = || std::iter::once(&self.head).chain(&self.rows);
        let mut text = format!("\n{}\n", self.title);
        for row in all() {
            // Row headers are words and are aligned left. The other columns are numbers and are
            // aligned right.
            let cells = row.iter().enumerate().map(|(column, cell)| match column {
                0 => format!("{cell:<0$}", self.width(column)),
                _ => format!("{cell:>0$}", self.width(column)),
            });
            text.push_str(&format!("  {}\n", cells.collect::<Vec<_>>().join("  ")));
        }
        text.trim_end().to_owned()
    }

    /// Number of characters of the longest cell of a column.
    fn width(&self, column: usize) -> usize {
        std::iter::once(&self.head)
            .chain(&self.rows)
            .filter_map(|row| row.get(column))
            .map(|cell| cell.chars().count())
            .max()
            .unwrap_or(0)
    }
}

/// A row of an HTML table.
///
/// * `tag`: tag of its cells, `td` or `th`.
pub fn html_row(cells: &[String], tag: &str) -> String {
    let cells: String = cells
        .iter()
        .map(|cell| format!("<{tag}>{}</{tag}>", escaped(cell)))
        .collect();
    format!("<tr>{cells}</tr>\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let words = |words: [&str; 2]| words.map(str::to_owned).to_vec();
        Table {
            title: "Sizes".into(),
            head: words(["data", "dB"]),
            rows: vec![words(["a<b", "1.25"])],
        }
    }

    #[test]
    fn tables_are_escaped_and_aligned() {
        assert_eq!(table().text(), "\nSizes\n  data    dB\n  a<b   1.25");
        assert!(
            table()
                .html()
                .contains("<tr><td>a&lt;b</td><td>1.25</td></tr>")
        );
    }
}
