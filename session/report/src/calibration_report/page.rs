//! Page layout: title, verdict, key figures, sections.

use super::Heading;
use crate::chart::drawing::escaped;
use crate::{STYLE, Table};

/// A key figure: name, value, unit.
pub type Figure = (&'static str, String, &'static str);

/// The beginning of the line below the title. It marks a file as a report.
pub(super) const SUBTITLE: &str = "<p class=\"sub\">fieldrig ";

/// A page with its sections.
pub struct Page {
    title: String,
    command: String,
    html: String,
}

impl Page {
    /// Begins a page.
    ///
    /// * `verdict`: the basis of the result, if there is a result.
    pub fn new(title: &str, heading: &Heading, verdict: &str, figures: &[Figure]) -> Self {
        let subtitle = [
            env!("CARGO_PKG_VERSION").to_owned(),
            heading.utc.clone(),
            heading.input.clone(),
        ];
        let (class, head, text) = match &heading.refused {
            Some(reason) => ("refused", "Refused", reason.as_str()),
            None if heading.warnings.is_empty() => ("accepted", "Accepted", verdict),
            None => ("doubtful", "Accepted, with warnings", verdict),
        };
        let mut html = format!(
            "<h1>{}</h1>\n{SUBTITLE}{}</p>\n<div class=\"verdict {class}\"><strong>{head}</strong><p>{}</p>{}</div>\n",
            escaped(title),
            escaped(&subtitle.join(" · ")),
            escaped(text),
            list(&heading.warnings)
        );
        if !figures.is_empty() {
            let figures: String = figures.iter().map(key_figure).collect();
            html.push_str(&format!("<dl class=\"figures\">\n{figures}</dl>\n"));
        }
        Self {
            title: title.to_owned(),
            command: heading.command.clone(),
            html,
        }
    }

    /// Adds a section. If the content is empty, nothing is added.
    ///
    /// * `legend`: what the section shows, as text.
    /// * `content`: HTML.
    pub fn section(&mut self, title: &str, legend: &str, content: &str) {
        if content.is_empty() {
            return;
        }
        let legend = if legend.is_empty() {
            String::new()
        } else {
            format!("<p class=\"legend\">{}</p>", escaped(legend))
        };
        self.html.push_str(&format!(
            "<h2>{}</h2>\n{legend}\n{content}\n",
            escaped(title)
        ));
    }

    /// Adds a table. Without rows, adds nothing.
    pub fn table(&mut self, title: &str, head: &[&str], rows: Vec<Vec<String>>) {
        if !rows.is_empty() {
            let head = head.iter().map(|name| (*name).to_owned()).collect();
            self.html.push_str(
                &Table {
                    title: title.to_owned(),
                    head,
                    rows,
                }
                .html(),
            );
        }
    }

    /// The complete page, with the command line at the end.
    pub fn finish(self) -> String {
        let command = escaped(&self.command);
        format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <title>{}</title>\n<style>\n{}{}</style></head>\n<body><main>\n{}\
             <h2>Command</h2>\n<p class=\"card command\"><code>{command}</code></p>\n</main></body></html>\n",
            escaped(&self.title),
            STYLE,
            include_str!("style.css"),
            self.html
        )
    }
}

/// A key figure as an entry of a description list.
fn key_figure((name, value, unit): &Figure) -> String {
    let unit = if unit.is_empty() {
        String::new()
    } else {
        format!("<small>{unit}</small>")
    };
    format!(
        "<div><dd>{}{unit}</dd><dt>{}</dt></div>\n",
        escaped(value),
        escaped(name)
    )
}

/// A list of sentences. The text is empty if there are no sentences.
fn list(sentences: &[String]) -> String {
    let items: String = sentences
        .iter()
        .map(|sentence| format!("<li>{}</li>", escaped(sentence)))
        .collect();
    if items.is_empty() {
        items
    } else {
        format!("<ul>{items}</ul>")
    }
}

/// A short text in a box. The result is empty if there is no text.
pub fn note(text: Option<&str>) -> String {
    text.map_or(String::new(), |text| {
        format!("<p class=\"card note\">{}</p>", escaped(text))
    })
}

/// A code line to copy.
pub fn code(text: Option<&str>) -> String {
    text.map_or(String::new(), |text| {
        format!(
            "<p class=\"card command\"><code>{}</code></p>",
            escaped(text)
        )
    })
}

/// A chart in a box.
pub fn chart(chart: &crate::chart::Chart) -> String {
    format!("<div class=\"chart card\">{}</div>\n", chart.draw().svg())
}

/// A picture with a caption.
pub fn figure(caption: &str, content: &str) -> String {
    format!(
        "<figure class=\"card\">{content}<figcaption>{}</figcaption></figure>\n",
        escaped(caption)
    )
}

/// Pictures next to each other.
pub fn gallery(figures: &[String]) -> String {
    if figures.is_empty() {
        String::new()
    } else {
        format!("<div class=\"gallery\">\n{}</div>", figures.concat())
    }
}
