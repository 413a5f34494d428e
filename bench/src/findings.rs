//! Writes the results of a bench as JSON with every number, as charts in SVG and PNG, and as an
//! HTML page.

use anyhow::{Context, Result, anyhow};
use report::Table;
use report::chart::drawing::escaped;
use report::chart::{Chart, raster};
use serde_json::Value;
use session::run_folder;
use std::path::{Path, PathBuf};

/// Results of a bench so far.
pub struct Findings {
    /// Base name of the files, such as `curve`, `budget` or `stability`.
    pub name: &'static str,
    /// Title of the page.
    pub title: String,
    /// Description of the measurement, for the page.
    pub sentences: Vec<String>,
    /// Charts, each with the suffix of its file names.
    pub charts: Vec<(&'static str, Chart)>,
    /// Tables, for the page and the terminal.
    pub tables: Vec<Table>,
    /// All numbers, for the JSON file.
    pub numbers: Value,
}

/// The results of a finished bench.
pub struct BenchResult {
    /// The results.
    pub findings: Findings,
    /// Path of the page.
    pub page: PathBuf,
    /// Input data that could not be read.
    pub data_losses: Vec<String>,
}

impl BenchResult {
    /// The result of a bench that trains, with the findings after its last run.
    pub(crate) fn of(
        latest: Option<(Findings, PathBuf)>,
        data_losses: Vec<String>,
    ) -> Result<Self> {
        let (findings, page) = latest.ok_or_else(|| anyhow!("there is nothing to train"))?;
        Ok(Self {
            findings,
            page,
            data_losses,
        })
    }
}

impl Findings {
    /// Writes all files, and returns the path of the page.
    ///
    /// # Errors
    ///
    /// Fails if a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<PathBuf> {
        // The numbers are written first, because they are the only part that cannot be recreated
        // from another part.
        let path_with = |suffix: &str| folder.join(format!("{}{suffix}", self.name));
        run_folder::write_json(&path_with(".json"), &self.numbers)?;
        let mut page = self.page_head();
        for (part, chart) in &self.charts {
            let drawing = chart.draw();
            let svg = drawing.svg();
            write_file(&path_with(&format!("{part}.svg")), svg.as_bytes())?;
            write_file(&path_with(&format!("{part}.png")), &raster::png(&drawing)?)?;
            let title = escaped(&chart.title);
            page.push_str(&format!(
                "<figure role=\"img\" aria-label=\"{title}\">\n{svg}</figure>\n"
            ));
        }
        for table in &self.tables {
            page.push_str(&table.html());
        }
        page.push_str("</main></body></html>\n");
        let page_path = path_with(".html");
        write_file(&page_path, page.as_bytes())?;
        Ok(page_path)
    }

    fn page_head(&self) -> String {
        let title = escaped(&self.title);
        let mut head = format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{title}</title>\n{STYLE}</head>\n\
             <body><main>\n<h1>{title}</h1>\n"
        );
        for sentence in &self.sentences {
            head.push_str(&format!("<p>{}</p>\n", escaped(sentence)));
        }
        head
    }
}

const STYLE: &str = "<style>\
body{font:16px/1.45 system-ui,sans-serif;color:#222;background:#fff;margin:0}\
main{max-width:980px;margin:2rem auto;padding:0 1rem}\
figure{margin:1.5rem 0;overflow-x:auto}svg{max-width:100%;height:auto}\
table{border-collapse:collapse;margin:.5rem 0 2rem;font-variant-numeric:tabular-nums;font-size:14px}\
th,td{padding:.3rem .8rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}\
th:first-child,td:first-child{text-align:left}h1{font-size:1.5rem}h2{font-size:1.1rem;margin-bottom:0}\
.wide{overflow-x:auto}</style>\n";

fn write_file(path_with: &Path, bytes: &[u8]) -> Result<()> {
    files::write(path_with, bytes).with_context(|| format!("cannot write {}", path_with.display()))
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
    fn findings_write_every_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let findings = Findings {
            name: "curve",
            title: "Curves".into(),
            sentences: vec!["One & all.".into()],
            charts: Vec::new(),
            tables: vec![table()],
            numbers: serde_json::json!({ "lines": [] }),
        };
        let page = findings
            .write(folder.path())
            .expect("the folder is writable");
        let text = std::fs::read_to_string(page).expect("a page");
        assert!(
            text.contains("<p>One &amp; all.</p>") && text.contains("<h2>Sizes</h2>"),
            "{text}"
        );
        assert!(folder.path().join("curve.json").is_file());
    }
}
