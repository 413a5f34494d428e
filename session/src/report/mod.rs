//! `report.html`: one page that works offline, with test images next to renders, scores and
//! settings of a training run.
//!
//! The page combines the content of `report.json`, renders of test images, and suggested next
//! commands.

mod coverage;
mod overview;
mod pictures;
mod scene_pictures;
mod seen_places;
mod wording;

pub(crate) use pictures::{Comparison, Scored, compare};
pub(crate) use scene_pictures::ScenePictures;
pub(crate) use wording::image_name;

use crate::next_commands::NextCommand;
use crate::{evaluation_schedule, likely_cause, run_folder, verdict};
use report::Table;
use report::chart::drawing::escaped;
use report::chart::{Axis, Chart, Line, Point, Scale};
use report::table::html_row;
use serde_json::{Map, Value};
use std::fmt::Write;
use std::path::Path;
use wording::{dropped_images, duration, is_omitted, label, value_text};

/// Name of the page in the folder of a run.
pub(crate) const FILE: &str = "report.html";
/// Tables with more rows than this are collapsed. A run has this many scheduled evaluations after
/// about two hours of training.
const MAX_OPEN_ROWS: usize = 16;

/// The content of the page.
pub(crate) struct Page<'a> {
    pub folder: &'a Path,
    /// The content of `report.json`.
    pub report: &'a Value,
    /// Singular name of the model's primitive, such as `splat`.
    pub primitive: &'a str,
    pub comparisons: &'a [Comparison],
    pub scene: &'a ScenePictures,
    pub next: &'a [NextCommand],
    /// Settings of the model from the decision log; `Null` if there is no log.
    pub settings: Value,
    /// The command line of the training.
    pub command: String,
    /// Date and time of day in UTC.
    pub date: String,
}

impl Page<'_> {
    /// Writes the page into the folder.
    pub(crate) fn write(&self) -> anyhow::Result<()> {
        run_folder::write_atomic(&self.folder.join(FILE), &self.html())
    }

    fn html(&self) -> String {
        let report = self.report;
        let done = &report["done"];
        let method = done["method"].as_str().unwrap_or("model");
        let title = escaped(&format!("{}, {}: {method}", self.name(), self.date));
        let mut page = format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <title>{title}</title>\n<style>\n{}</style></head>\n<body><main>\n<h1>{title}</h1>\n<p class=\"sub\">{}</p>\n",
            report::STYLE,
            escaped(&self.subtitle())
        );
        page.push_str(&verdict_line(report));
        page.push_str(&figures(done, self.primitive));
        page.push_str(&data_losses(report));
        page.push_str(&self.scene.html());
        page.push_str(&commands(self.next));
        page.push_str(&comparison_section(
            self.comparisons,
            array(&report["per_image"]).len(),
        ));
        page.push_str(&curve(report, method));
        page.push_str(&collapsible(
            &scores_of_images(report),
            "Scores of all test images",
        ));
        page.push_str(&collapsible(
            &evaluations_table(report, self.primitive),
            "Scores during training",
        ));
        page.push_str(&collapsible(&latencies(&report["latencies"]), "Latency"));
        page.push_str(&trials(&report["trials"]));
        page.push_str(&self.settings_tables());
        page.push_str("</main></body></html>\n");
        page
    }

    /// Name of the rig or of the data. If neither is known, the name of the folder.
    fn name(&self) -> String {
        let text = |key: &str| self.report[key].as_str().map(str::to_owned);
        let data = text("data").map(|data| {
            let name = Path::new(&data).file_name();
            name.map_or(data.clone(), |name| name.to_string_lossy().into_owned())
        });
        let folder = || self.folder.display().to_string();
        text("rig").or(data).unwrap_or_else(folder)
    }

    /// Folder, program version, data and device in one line.
    fn subtitle(&self) -> String {
        let text = |key: &str| self.report[key].as_str().map(str::to_owned);
        let words = [
            Some(self.folder.display().to_string()),
            Some(format!("fieldrig {}", env!("CARGO_PKG_VERSION"))),
            text("data"),
            text("adapter"),
        ];
        words.into_iter().flatten().collect::<Vec<_>>().join(" · ")
    }

    fn settings_tables(&self) -> String {
        let excluded_keys = [
            "done",
            "data_losses",
            "evaluations",
            "latencies",
            "trials",
            "passes",
            "per_image",
            "rig",
        ];
        let extra = self.report.as_object().into_iter().flatten();
        let extra = extra.filter(|(key, _)| !excluded_keys.contains(&key.as_str()));
        let mut run: Vec<Vec<String>> = vec![vec!["command".to_owned(), self.command.clone()]];
        run.extend(extra.flat_map(|(key, value)| rows_of(key, value)));
        run.extend(rows_of(
            "model sha256",
            &self.report["done"]["checkpoint_sha256"],
        ));
        // Empty unless profiling was requested.
        let passes = array(&self.report["passes"]).iter().filter_map(|pass| {
            Some(vec![
                format!("GPU time of {}", pass[0].as_str()?),
                format!("{:.3} ms", pass[1].as_f64()?),
            ])
        });
        run.extend(passes);
        let mut html = settings_table("This run", run, false);
        if let Value::Object(settings) = &self.settings {
            let rows = settings
                .iter()
                .flat_map(|(key, value)| rows_of(key, value))
                .collect();
            html.push_str(&settings_table("All settings of the model", rows, true));
        }
        html
    }
}

/// How good the model is, in one sentence, and the likely cause of a poor result.
fn verdict_line(report: &Value) -> String {
    let verdict = verdict::of_report(report).map_or(String::new(), |verdict| {
        format!("<p class=\"verdict\">{}.</p>\n", escaped(&verdict.text))
    });
    let cause = likely_cause::of_report(report).map_or(String::new(), |cause| {
        format!("<p>Likely cause: {}.</p>\n", escaped(&cause))
    });
    verdict + &cause
}

/// The main scores and sizes.
fn figures(done: &Value, primitive: &str) -> String {
    let number = |key: &str| done[key].as_f64();
    let scaled = |key: &str, factor: f64, digits: usize| {
        number(key).map(|value| format!("{:.digits$}", factor * value))
    };
    let primitives = format!("{primitive}s");
    let entries = [
        (
            "test PSNR",
            scaled("psnr", 1.0, 2).or(Some("–".to_owned())),
            "dB",
        ),
        ("SSIM", scaled("ssim", 1.0, 4), ""),
        ("LPIPS", scaled("lpips", 1.0, 4), ""),
        ("depth RMSE", scaled("depth_rmse_m", 1e3, 1), "mm"),
        ("surface error", scaled("surface_error_m", 1e3, 1), "mm"),
        (
            "surface within 5 mm",
            scaled("surface_within_5_mm", 1e2, 1),
            "%",
        ),
        ("PSNR against truth", scaled("psnr_truth", 1.0, 2), "dB"),
        ("training time", number("seconds").map(duration), ""),
        ("steps", number("steps").map(grouped), ""),
        (primitives.as_str(), number("primitives").map(grouped), ""),
        ("GPU memory", scaled("bytes", 1e-6, 1), "MB"),
    ];
    let mut html = String::from("<dl class=\"figures\">\n");
    for (name, value, unit) in entries {
        let Some(value) = value else { continue };
        let unit = if unit.is_empty() {
            String::new()
        } else {
            format!("<small>{unit}</small>")
        };
        writeln!(
            html,
            "<div><dd>{value}{unit}</dd><dt>{}</dt></div>",
            escaped(name)
        )
        .expect("a String never fails");
    }
    for (camera, psnr) in done["psnr_per_camera"].as_object().into_iter().flatten() {
        let camera = escaped(camera);
        let psnr = psnr.as_f64().unwrap_or_default();
        writeln!(
            html,
            "<div><dd>{psnr:.2}<small>dB</small></dd><dt>PSNR of {camera}</dt></div>"
        )
        .expect("a String never fails");
    }
    html.push_str("</dl>\n");
    html
}

/// The losses of data, the images that devices dropped first.
fn data_losses(report: &Value) -> String {
    let losses = array(&report["data_losses"]);
    let items: String = dropped_images(report)
        .into_iter()
        .chain(losses.iter().filter_map(Value::as_str).map(str::to_owned))
        .map(|loss| format!("<li>{}</li>", escaped(&loss)))
        .collect();
    if items.is_empty() {
        return String::new();
    }
    format!("<div class=\"warn\"><strong>Lost data</strong><ul>{items}</ul></div>\n")
}

fn commands(next: &[NextCommand]) -> String {
    if next.is_empty() {
        return String::new();
    }
    let mut entries = String::new();
    for NextCommand { purpose, command } in next {
        let purpose = escaped(purpose);
        let command = escaped(command);
        entries.push_str(&format!(
            "<dt>{purpose}</dt><dd><code>{command}</code></dd>\n"
        ));
    }
    format!("<h2>Next commands</h2>\n<dl class=\"commands card\">\n{entries}</dl>\n")
}

/// Test images next to renders.
fn comparison_section(comparisons: &[Comparison], n_tests: usize) -> String {
    if comparisons.is_empty() {
        let reason = if n_tests == 0 {
            "there are no test images"
        } else {
            "no test image could be drawn"
        };
        return format!("<h2>Test images</h2>\n<p class=\"legend\">No comparison: {reason}.</p>\n");
    }
    let count_note = if comparisons.len() == n_tests {
        String::new()
    } else {
        format!(
            "{} of {n_tests} test images, including the best and the worst. ",
            comparisons.len()
        )
    };
    let mut html = format!(
        "<h2>Test images</h2>\n<p class=\"legend\">{count_note}Left to right: the camera image, the model's render from the \
         same pose, and, in one column, their difference and the depth of the render. None of these images was used for \
         training.</p>\n<div class=\"comparisons\">\n"
    );
    let by_psnr = |a: &&Comparison, b: &&Comparison| a.psnr.total_cmp(&b.psnr);
    let worst = comparisons.iter().min_by(by_psnr);
    let best = comparisons.iter().max_by(by_psnr);
    for comparison in comparisons {
        let is =
            |other: Option<&Comparison>| other.is_some_and(|other| std::ptr::eq(other, comparison));
        // Tags are useful only for three or more images. Of one or two images, every image would be
        // the best or the worst.
        let tag = match comparisons.len() {
            ..3 => "",
            _ if is(worst) => "<span class=\"tag\">worst</span>",
            _ if is(best) => "<span class=\"tag\">best</span>",
            _ => "",
        };
        html.push_str(&comparison_card(comparison, tag));
    }
    html.push_str("</div>\n");
    html
}

fn comparison_card(comparison: &Comparison, tag: &str) -> String {
    let Comparison {
        name,
        psnr,
        ssim,
        size_px: [width, height],
        image,
        render,
        error,
        depth,
    } = comparison;
    let name = escaped(name);
    let ssim = ssim.map_or(String::new(), |ssim| format!("<span>SSIM {ssim:.4}</span>"));
    let figure = |source: &str, caption: &str| {
        format!(
            "<figure><img loading=\"lazy\" width=\"{width}\" height=\"{height}\" alt=\"{caption}, {name}\" src=\"{source}\">\
             <figcaption>{caption}</figcaption></figure>\n"
        )
    };
    let depth = depth.as_ref().map_or(String::new(), |depth| {
        let [near, far] = depth.range_m;
        figure(
            &depth.picture,
            &format!("depth, {near:.2} m (red) to {far:.2} m (blue)"),
        )
    });
    let shape = if height > width { " tall" } else { "" };
    format!(
        "<article class=\"comparison card{shape}\"><h3>{name}<span>{psnr:.2} dB</span>{ssim}{tag}</h3>\n<div class=\"pair\">\n{}{}\
         <div class=\"stack\">{}{depth}</div></div></article>\n",
        figure(image, "test image"),
        figure(render, "render"),
        figure(error, "error, brightest at 25 % or more")
    )
}

/// Accuracy over time.
fn curve(report: &Value, method: &str) -> String {
    let mut points: Vec<(f64, f64)> = array(&report["evaluations"])
        .iter()
        .filter_map(curve_point)
        .collect();
    let last_secs = points.last().map_or(0.0, |(secs, _)| *secs);
    // The final evaluation often follows a scheduled one at once. Two points at the same place
    // would look like a jump.
    points.extend(curve_point(&report["done"]).filter(|(secs, _)| *secs > 1.01 * last_secs));
    if points.len() < 2 {
        return String::new();
    }
    let chart = Chart {
        title: "PSNR of test images over time".into(),
        subtitle: "the last point is the saved model".into(),
        x: Axis {
            label: "seconds of training (log)".into(),
            scale: Scale::Log,
            ticks: evaluation_schedule::up_to(
                1.1 * last_secs.max(points.last().map_or(0.0, |(secs, _)| *secs)),
            )
            .collect(),
        },
        y: Axis {
            label: "test PSNR, dB".into(),
            scale: Scale::Linear,
            ticks: Vec::new(),
        },
        lines: vec![Line {
            label: method.to_owned(),
            points: points
                .iter()
                .map(|(x, y)| Point {
                    x: *x,
                    y: *y,
                    low: *y,
                    high: *y,
                })
                .collect(),
            is_peer: false,
        }],
        thresholds: Vec::new(),
        markers: Vec::new(),
    };
    format!(
        "<h2>Training curve</h2>\n<div class=\"chart card\">{}</div>\n",
        chart.draw().svg()
    )
}

/// Training time in seconds and PSNR of an evaluation; `None` if one is unknown.
fn curve_point(evaluation: &Value) -> Option<(f64, f64)> {
    // The time axis is logarithmic.
    let secs = evaluation["seconds"].as_f64().filter(|secs| *secs > 0.0)?;
    Some((secs, evaluation["psnr"].as_f64()?))
}

fn scores_of_images(report: &Value) -> Table {
    let columns = [
        ("psnr", "PSNR, dB", 1.0, 2),
        ("ssim", "SSIM", 1.0, 4),
        ("lpips", "LPIPS", 1.0, 4),
        ("depth_rmse_m", "depth RMSE, mm", 1e3, 1),
        ("surface_error_m", "surface, mm", 1e3, 1),
        ("psnr_truth", "PSNR against truth, dB", 1.0, 2),
    ];
    table(
        "Scores of all test images",
        &report["per_image"],
        ("name", "image"),
        &columns,
    )
}

fn evaluations_table(report: &Value, primitive: &str) -> Table {
    let primitives = format!("{primitive}s");
    let columns = [
        ("step", "step", 1.0, 0),
        ("psnr", "PSNR, dB", 1.0, 2),
        ("ssim", "SSIM", 1.0, 4),
        ("lpips", "LPIPS", 1.0, 4),
        ("depth_rmse_m", "depth RMSE, mm", 1e3, 1),
        ("n_images", "test images", 1.0, 0),
        ("primitives", primitives.as_str(), 1.0, 0),
        ("bytes", "MB", 1e-6, 1),
        ("step_millis", "ms per step", 1.0, 2),
    ];
    table(
        "Scores during training",
        &report["evaluations"],
        ("seconds", "seconds"),
        &columns,
    )
}

/// A column: key, header, factor, number of decimals.
type Column<'a> = (&'a str, &'a str, f64, usize);

/// A table with one row per object. Columns without any value are left out.
fn table(title: &str, objects: &Value, (key, head): (&str, &str), columns: &[Column<'_>]) -> Table {
    let objects = array(objects);
    let is_known = |column: &&Column<'_>| objects.iter().any(|object| object[column.0].is_number());
    let columns: Vec<&Column<'_>> = columns.iter().filter(is_known).collect();
    let row = |object: &Value| -> Vec<String> {
        std::iter::once(row_header(&object[key]))
            .chain(columns.iter().map(|column| cell(object, column)))
            .collect()
    };
    Table {
        title: title.to_owned(),
        head: std::iter::once(head)
            .chain(columns.iter().map(|column| column.1))
            .map(str::to_owned)
            .collect(),
        rows: objects.iter().map(row).collect(),
    }
}

/// Text of a cell.
fn cell(object: &Value, (key, _, factor, digits): &Column<'_>) -> String {
    match object[*key].as_f64() {
        Some(value) if *digits == 0 => grouped(factor * value),
        Some(value) => format!("{:.*}", *digits, factor * value),
        None => "–".to_owned(),
    }
}

/// Text of the first cell of a row: a name, or a time.
fn row_header(value: &Value) -> String {
    match value {
        Value::Number(number) => format!("{:.2}", number.as_f64().unwrap_or_default()),
        other => text_of(other),
    }
}

/// HTML of a table: collapsed if the table is long, nothing if it is empty.
fn collapsible(table: &Table, title: &str) -> String {
    match table.rows.len() {
        0 => String::new(),
        1..=MAX_OPEN_ROWS => table.html(),
        n => format!(
            "<details><summary>{}: {n} rows</summary>\n{}</details>\n",
            escaped(title),
            table.html()
        ),
    }
}

/// Durations of a live run.
fn latencies(latencies: &Value) -> Table {
    let head = ["duration", "median, ms", "99 %, ms", "keyframes"]
        .map(str::to_owned)
        .to_vec();
    Table {
        title: "Latency, without pauses of the training".into(),
        head,
        rows: array(latencies).iter().filter_map(latency_row).collect(),
    }
}

/// The row of a stage; `None` if the report has another form.
fn latency_row(latency: &Value) -> Option<Vec<String>> {
    let [name, values] = latency.as_array()?.as_slice() else {
        return None;
    };
    Some(vec![
        text_of(name),
        whole_millis(&values["p50"]),
        whole_millis(&values["p99"]),
        text_of(&values["n"]),
    ])
}

/// A whole number of milliseconds.
fn whole_millis(value: &Value) -> String {
    value
        .as_f64()
        .map_or("–".to_owned(), |millis| format!("{millis:.0}"))
}

/// The results of A/B trials.
fn trials(trials: &Value) -> String {
    let rows: Vec<Vec<String>> = array(trials).iter().map(trial_row).collect();
    if rows.is_empty() {
        return String::new();
    }
    let head = ["candidate", "gain, dB", "images", "result"]
        .map(str::to_owned)
        .to_vec();
    Table {
        title: "Trials during training".into(),
        head,
        rows,
    }
    .html()
}

/// The row of a trial.
fn trial_row(trial: &Value) -> Vec<String> {
    let number = |key: &str| trial[key].as_f64().unwrap_or_default();
    let kept = if trial["kept"] == Value::Bool(true) {
        "kept"
    } else {
        "dropped"
    };
    let gain = format!(
        "{:+.2} ± {:.2}",
        number("gain_db"),
        number("standard_error_db")
    );
    vec![
        text_of(&trial["candidate"]),
        gain,
        text_of(&trial["n_images"]),
        kept.to_owned(),
    ]
}

fn settings_table(title: &str, rows: Vec<Vec<String>>, is_collapsed: bool) -> String {
    let rows: String = rows.iter().map(|cells| html_row(cells, "td")).collect();
    let table =
        format!("<div class=\"wide settings\"><table><tbody>\n{rows}</tbody></table></div>\n");
    if is_collapsed {
        format!("<details><summary>{title}</summary>\n{table}</details>\n")
    } else {
        format!("<h2>{title}</h2>\n{table}")
    }
}

/// Table rows for a value: one row per key for objects, none for empty values.
fn rows_of(key: &str, value: &Value) -> Vec<Vec<String>> {
    if is_omitted(key, value) {
        return Vec::new();
    }
    if let Some(text) = value_text(key, value) {
        return vec![vec![label(key), text]];
    }
    let key = label(key);
    match value {
        Value::Null => Vec::new(),
        Value::Array(items) if items.is_empty() => Vec::new(),
        Value::Object(map) => map
            .iter()
            .flat_map(|(inner, value)| rows_of(&format!("{key}: {inner}"), value))
            .collect(),
        // A list of objects in one cell would be unreadable.
        Value::Array(items) if items.iter().any(Value::is_object) => {
            let numbered = items.iter().enumerate();
            numbered
                .map(|(ix, item)| vec![format!("{key} {}", ix + 1), text_of(item)])
                .collect()
        }
        other => vec![vec![key, text_of(other)]],
    }
}

/// A value as one line of text.
fn text_of(value: &Value) -> String {
    match value {
        Value::Null => "–".to_owned(),
        Value::Bool(is_true) => String::from(if *is_true { "yes" } else { "no" }),
        Value::String(text) => text.clone(),
        Value::Number(number) => match number.as_f64() {
            Some(float) if !number.is_i64() && !number.is_u64() => short_float(float),
            _ => number.to_string(),
        },
        Value::Array(items) => items.iter().map(text_of).collect::<Vec<_>>().join(", "),
        Value::Object(map) => words_of(map).join(", "),
    }
}

/// Keys and values of a map, as text.
fn words_of(map: &Map<String, Value>) -> Vec<String> {
    map.iter()
        .filter(|(_, value)| !value.is_null())
        .map(|(key, value)| format!("{} {}", key.replace('_', " "), text_of(value)))
        .collect()
}

/// A number with up to four decimals; in scientific notation if it is very small or large.
fn short_float(value: f64) -> String {
    if value == 0.0 || (1e-3..1e6).contains(&value.abs()) {
        let text = format!("{value:.4}");
        return text.trim_end_matches('0').trim_end_matches('.').to_owned();
    }
    format!("{value:.3e}")
}

/// A whole number with its digits in groups of three.
fn grouped(value: f64) -> String {
    let digits = format!("{:.0}", value.abs());
    let mut text = String::from(if value < 0.0 { "-" } else { "" });
    for (ix, digit) in digits.chars().enumerate() {
        if ix > 0 && (digits.len() - ix).is_multiple_of(3) {
            // A narrow space without a line break.
            text.push('\u{202f}');
        }
        text.push(digit);
    }
    text
}

fn array(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// The settings of a run: the first line of the newest decision log in a folder; `Null` if there is
/// no log.
pub(crate) fn settings_in(folder: &Path) -> Value {
    // A run that continues from a checkpoint has a separate log, named after its first step.
    let names = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let newest = names
        .filter_map(|entry| Some((first_step(entry.file_name().to_str()?)?, entry.path())))
        .max();
    let path = newest.map_or_else(|| folder.join("decisions.jsonl"), |(_, path)| path);
    first_line(&path).unwrap_or_default()
}

/// The step in the name of a log that continues from a checkpoint; `None` for other names.
fn first_step(log_name: &str) -> Option<u64> {
    log_name
        .strip_prefix("decisions-from-")?
        .strip_suffix(".jsonl")?
        .parse()
        .ok()
}

/// The JSON in the first line of a file; `None` if there is none.
fn first_line(path: &Path) -> Option<Value> {
    let text = files::read_text(path).ok()?;
    serde_json::from_str(text.lines().next()?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn page(report: &Value) -> String {
        let next = NextCommand {
            purpose: "view the model".into(),
            command: "fieldrig view 'a <b>'".into(),
        };
        let page = Page {
            folder: Path::new("runs/a <b>"),
            report,
            primitive: "splat",
            comparisons: &[],
            scene: &ScenePictures::default(),
            next: &[next],
            settings: json!({ "options": { "seed": 7, "caps": null } }),
            command: "fieldrig train data".into(),
            date: "2026-11-29 10:57 UTC".into(),
        };
        page.html()
    }

    #[test]
    fn page_shows_scores_commands_and_settings_escaped() {
        let html = page(&json!({
            "done": { "method": "splat", "psnr": 23.456, "ssim": 0.9, "seconds": 750.0, "steps": 12345, "primitives": 4000000,
                      "bytes": 8000000, "psnr_per_camera": { "wrist": 22.0 } },
            "rig": "arm <1>", "data": "my data", "adapter": "a GPU", "keyframes": 7, "evicted": 0, "device_skipped": 90,
            "max_position_error_m": 6.262e-16,
            "data_losses": ["1 image <broken>"],
            "evaluations": [{ "seconds": 0.5, "psnr": 20.0, "step": 10, "step_millis": 1.5 }, { "seconds": 4.0, "psnr": 22.0 }],
            "per_image": [{ "name": "images/1.jpg", "psnr": 23.456, "ssim": null }],
            "trials": [{ "candidate": "joints", "gain_db": 0.5, "standard_error_db": 0.1, "n_images": 9, "kept": true }],
            "rejected": { "blurred": 3 }, "alignment": null,
            "latencies": [["shutter to shown", { "p50": 181.7, "p99": 640.2, "n": 95 }]],
        }));
        for words in [
            "<title>arm &lt;1&gt;, 2026-11-29 10:57 UTC: splat</title>",
            "runs/a &lt;b&gt; · fieldrig ",
            "<dd>12 min 30 s</dd><dt>training time</dt>",
            "90 % of the images were dropped by the devices: 90 of 100 never",
            "<td>images dropped by devices</td><td>90</td>",
            "<td>largest error of a camera position (simulation)</td><td>0.00 mm</td>",
            "23.46<small>dB</small>",
            "12\u{202f}345",
            "4\u{202f}000\u{202f}000",
            "PSNR of wrist",
            "1 image &lt;broken&gt;",
            "<code>fieldrig view 'a &lt;b&gt;'</code>",
            "<svg ",
            "images/1.jpg",
            "+0.50 ± 0.10",
            "<td>shutter to shown</td><td>182</td><td>640</td><td>95</td>",
            "<td>images that became no keyframe: blurred</td><td>3</td>",
            "<td>options: seed</td><td>7</td>",
            "prefers-color-scheme: dark",
        ] {
            assert!(html.contains(words), "{words} is missing: {html}");
        }
        assert!(!html.contains("<b>") && !html.contains("alignment") && !html.contains("NaN"));
        assert!(!html.contains("evicted") && !html.contains("because the store was full"));
        assert!(
            !html.contains("http://")
                || html.matches("http://").count() == html.matches("http://www.w3.org").count()
        );
    }

    #[test]
    fn page_without_scores_is_valid() {
        let html = page(
            &json!({ "done": { "method": "tsdf", "psnr": null }, "evaluations": [], "per_image": [] }),
        );
        assert!(
            html.contains("there are no test images") && !html.contains("<svg "),
            "{html}"
        );
    }

    #[test]
    fn values_are_formatted_compactly() {
        let texts = [
            json!(0.000_012_34),
            json!(0.5),
            json!(7),
            json!([1.25, 2]),
            json!(true),
            json!({ "a_b": 1, "c": null }),
        ];
        assert_eq!(
            texts.each_ref().map(text_of),
            ["1.234e-5", "0.5", "7", "1.25, 2", "yes", "a b 1"]
        );
        assert_eq!(
            [0.0, 999.0, 1000.0, -1_234_567.0].map(grouped),
            ["0", "999", "1\u{202f}000", "-1\u{202f}234\u{202f}567"]
        );
    }

    #[test]
    fn settings_come_from_the_newest_log() {
        let folder = tempfile::tempdir().expect("a folder");
        assert_eq!(settings_in(folder.path()), Value::Null);
        let write = |name: &str, step: u64| {
            let lines = format!(
                "{}\n{}\n",
                json!({ "from_step": step }),
                json!({ "end": true })
            );
            std::fs::write(folder.path().join(name), lines).expect("disk space");
        };
        write("decisions.jsonl", 0);
        assert_eq!(settings_in(folder.path())["from_step"], 0);
        write("decisions-from-9.jsonl", 9);
        write("decisions-from-100.jsonl", 100);
        assert_eq!(settings_in(folder.path())["from_step"], 100);
    }
}
