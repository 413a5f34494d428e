//! Opens the page with a study in a real browser, and leads two participants through five conditions
//! with three tasks each, as an experimenter does. Then saves the CSV file and the box plots.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use serde_json::{Value, json};
use std::path::PathBuf;
use test_support::browser::{Browser, NO_DRAWING, browser_for_page, wait_for};
use viz::{Hub, ModelStatus, Server, ServerConfig, Status};

const WINDOW_PX: [u32; 2] = [1280, 860];
const N_CONDITIONS: usize = 5;
const N_TASKS: usize = 3;
const N_STATEMENTS: usize = 4;

/// Keeps files that the page saves in `window.saved`, by name.
const KEEP_FILES: &str = "
    window.saved = {};
    const files = new Map();
    URL.createObjectURL = (file) => { const url = `blob:${files.size}`; files.set(url, file); return url; };
    URL.revokeObjectURL = () => undefined;
    HTMLAnchorElement.prototype.click = function () {
        const name = this.download;
        void files.get(this.href).text().then((text) => (window.saved[name] = text));
    };
";

/// A model with this method.
fn model(method: &str) -> ModelStatus {
    ModelStatus {
        method: method.to_owned(),
        step: 100,
        ..ModelStatus::default()
    }
}

#[test]
fn participants_are_led_through_five_conditions_with_three_tasks() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    // The server lacks the model of one condition.
    hub.set_status(Status {
        state: "viewing".to_owned(),
        model: model("splat"),
        others: vec![model("tsdf")],
        ..Status::default()
    });
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let server = Server::start(config, hub).expect("a free port");
    let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    let url = format!("{}?study", server.url());
    let script = format!("{NO_DRAWING}\n{KEEP_FILES}");
    let mut browser = Browser::open_with(&program, &url, WINDOW_PX, &script);
    for participant in 1..=2 {
        participate(&mut browser, participant, &scratch);
    }

    for id in ["study-csv", "study-ratings", "study-times"] {
        browser.click(id);
    }
    let csv = saved(&mut browser, "study.csv");
    check_csv(&csv);
    for name in ["study-ratings.svg", "study-times.svg"] {
        let svg = saved(&mut browser, name);
        let n_groups = if name.contains("ratings") {
            N_STATEMENTS
        } else {
            N_TASKS
        };
        let n_boxes = svg.matches("class=\"box\"").count();
        assert_eq!(n_boxes, n_groups * N_CONDITIONS, "{name}");
        std::fs::write(scratch.join(name), svg).expect("written");
    }
    drop(browser);
}

/// Waits for a step of the study.
fn wait_for_step(browser: &mut Browser, step: &str) {
    wait_for(browser, step, |browser| {
        browser.evaluate("document.getElementById('study')?.dataset.step ?? ''") == json!(step)
    });
}

/// Fills in all steps of a participant.
fn participate(browser: &mut Browser, participant: usize, scratch: &std::path::Path) {
    wait_for_step(browser, "setup");
    assert_eq!(
        browser.evaluate("document.getElementById('study-participant').value"),
        json!(participant.to_string()),
        "the next number is proposed"
    );
    screenshot(browser, scratch, participant, "setup");
    browser.click("study-begin");
    wait_for_step(browser, "background");
    browser.evaluate("document.getElementById('study-age').value = '26'; 0");
    browser.click("study-continue");
    for place in 1..=N_CONDITIONS {
        wait_for_step(browser, "condition");
        check_condition(browser);
        if place == 2 {
            reload(browser);
            wait_for_step(browser, "condition");
        }
        screenshot(browser, scratch, participant, &format!("condition-{place}"));
        browser.click("study-continue");
        for task in 1..=N_TASKS {
            wait_for_step(browser, "task");
            let title = browser.evaluate("document.querySelector('#study h2').textContent");
            let expected = format!("Task {task} of {N_TASKS}");
            assert!(
                title
                    .as_str()
                    .is_some_and(|title| title.starts_with(&expected)),
                "{title}"
            );
            // A task cannot end before it has begun.
            assert_eq!(
                browser.evaluate("document.getElementById('study-done').disabled"),
                true
            );
            browser.click("study-start");
            let is_given_up = participant == 2 && place == 1 && task == 1;
            browser.click(if is_given_up {
                "study-give-up"
            } else {
                "study-done"
            });
        }
        wait_for_step(browser, "rating");
        // Statements without a rating are not accepted.
        browser.click("study-continue");
        wait_for_step(browser, "rating");
        let rating = 1 + (place + participant) % 5;
        browser.evaluate(&format!(
            "document.querySelectorAll('#study input[value=\"{rating}\"]').forEach((input) => input.click()); 0"
        ));
        screenshot(browser, scratch, participant, &format!("rating-{place}"));
        browser.click("study-continue");
    }
    wait_for_step(browser, "preference");
    browser.evaluate("document.getElementById('study-choice').value = 'splats-headset'; 0");
    browser.click("study-continue");
    wait_for_step(browser, "end");
    browser.click("study-next");
}

/// Conditions on the screen are shown, and the page says which model is missing.
fn check_condition(browser: &mut Browser) {
    let text = browser.text("study");
    let shown = "document.querySelector('#models [aria-pressed=\"true\"]')?.dataset.method ?? ''";
    if text.contains("Mesh on the screen") {
        wait_for(browser, "the mesh", |browser| {
            browser.evaluate(shown) == json!("tsdf")
        });
    }
    let is_missing = text.contains("Radiance field on the screen");
    assert_eq!(
        text.contains("This server has no model of the method nerf"),
        is_missing,
        "{text}"
    );
    let is_in_headset = !text.contains("on the screen");
    assert_eq!(text.contains("Put on the headset"), is_in_headset, "{text}");
}

/// Loads the page again. The study continues where it was.
fn reload(browser: &mut Browser) {
    browser.evaluate("window.isOld = true");
    browser.call("Page.reload", json!({}));
    wait_for(browser, "the page", |browser| {
        browser.evaluate("window.isOld === undefined && document.getElementById('study') !== null")
            == true
            && !browser.text("state").is_empty()
    });
}

fn screenshot(browser: &mut Browser, scratch: &std::path::Path, participant: usize, step: &str) {
    if participant == 1 {
        let path = scratch.join(format!("page-study-{step}.png"));
        std::fs::write(path, browser.screenshot()).expect("written");
    }
}

/// The text of a saved file.
fn saved(browser: &mut Browser, name: &str) -> String {
    let read = format!("window.saved['{name}'] ?? null");
    wait_for(browser, name, |browser| !browser.evaluate(&read).is_null());
    let text: Value = browser.evaluate(&read);
    text.as_str().expect("a text").to_owned()
}

fn check_csv(csv: &str) {
    let rows: Vec<Vec<&str>> = csv.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(
        rows[0],
        [
            "participant",
            "kind",
            "place",
            "condition",
            "item",
            "value",
            "outcome"
        ]
    );
    for participant in ["1", "2"] {
        let of_kind = |kind: &str| -> Vec<&Vec<&str>> {
            let is_wanted = |row: &&Vec<&str>| row[0] == participant && row[1] == kind;
            rows.iter().filter(is_wanted).collect()
        };
        let tasks = of_kind("task");
        assert_eq!(tasks.len(), N_CONDITIONS * N_TASKS, "{csv}");
        assert!(
            tasks
                .iter()
                .all(|row| row[5].parse::<f64>().is_ok_and(|secs| secs >= 0.0)),
            "{csv}"
        );
        assert_eq!(
            of_kind("rating").len(),
            N_CONDITIONS * N_STATEMENTS,
            "{csv}"
        );
        assert_eq!(of_kind("background")[0][4..6], ["age", "26"]);
        assert_eq!(of_kind("preference")[0][3], "splats-headset");
        let n_given_up = tasks.iter().filter(|row| row[6] == "given up").count();
        assert_eq!(n_given_up, usize::from(participant == "2"));
        // Every condition occurs, and all ratings of a condition are those that were given at its place.
        for row in of_kind("rating") {
            let place: usize = row[2].parse().expect("a number");
            let number: usize = participant.parse().expect("a number");
            assert_eq!(row[5], (1 + (place + number) % 5).to_string(), "{row:?}");
        }
    }
    let orders = ["1", "2"].map(|participant| {
        let mut order: Vec<&str> = rows
            .iter()
            .filter(|row| row[0] == participant && row[1] == "rating")
            .map(|row| row[3])
            .collect();
        order.dedup();
        order
    });
    assert!(
        orders.iter().all(|order| order.len() == N_CONDITIONS),
        "{orders:?}"
    );
    assert_ne!(orders[0], orders[1], "the order is counter-balanced");
}
