//! The questions of `fieldrig init` on a terminal. Each has a default and a flag.

use super::parent;
use crate::print;
use anyhow::Context;
use capture::config::Parent;
use capture::init::{
    Findings, RobotChoice, WantedCamera, Wishes, controller_at, default_parent, likely_robot,
    missing_controller,
};
use capture::known_robots::KNOWN_ROBOTS;
use drivers::NetworkAddress;
use messages::BadInput;
use std::io::{BufRead, IsTerminal};
use std::path::Path;

/// Maximum number of cameras whose places are asked for. The others get their defaults.
const MAX_CAMERAS: usize = 3;
/// Number of invalid answers after which the command ends. A default never replaces an answer.
const MAX_ATTEMPTS: usize = 3;

/// Asks for what flags leave open.
#[derive(Debug)]
pub(super) struct Questions {
    is_asking: bool,
}

impl Questions {
    /// Questions that are asked on a terminal, unless the user accepts all defaults.
    pub(super) fn new(accepts_defaults: bool) -> Self {
        Self {
            is_asking: !accepts_defaults && std::io::stdin().is_terminal(),
        }
    }

    /// Asks all questions. Answers become part of the wishes and findings.
    pub(super) fn ask(
        &self,
        wishes: &mut Wishes,
        findings: &mut Findings,
        rig: &Path,
    ) -> anyhow::Result<()> {
        if !self.is_asking {
            return Ok(());
        }
        if wishes.robot == RobotChoice::Automatic {
            wishes.robot = ask_robot(findings, rig)?;
        }
        if let Some(kind) = missing_controller(wishes, findings) {
            let question =
                format!("Address of the {kind} controller, or empty to simulate the arm");
            let address = answer(&question, "", complete_address)?;
            if !address.is_empty() {
                let controller = controller_at(kind, &address);
                if let Some(problem) = &controller.problem {
                    print::notice(format_args!("no {kind} controller answers now: {problem}"));
                }
                findings.controllers.push(controller);
            }
        }
        if wishes.cameras.is_empty() {
            wishes.cameras = ask_places(wishes, findings)?;
        }
        Ok(())
    }
}

/// An answer that is an address of a controller, or empty.
fn complete_address(text: &str) -> anyhow::Result<String> {
    if !text.is_empty() {
        NetworkAddress::parse(text).map_err(anyhow::Error::msg)?;
    }
    Ok(text.to_owned())
}

fn ask_robot(findings: &Findings, rig: &Path) -> anyhow::Result<RobotChoice> {
    let names: Vec<_> = KNOWN_ROBOTS.iter().map(|robot| robot.name).collect();
    let question = format!("Robot: {}, none, or the path of a URDF", names.join(", "));
    let likely = likely_robot(findings).map_or("", |robot| robot.name);
    answer(&question, likely, |text| {
        if text.is_empty() {
            return Ok(RobotChoice::Automatic);
        }
        if text.contains(['/', '.']) {
            return RobotChoice::of_urdf(Path::new(text), rig);
        }
        Ok(RobotChoice::named(text)?)
    })
}

fn ask_places(wishes: &Wishes, findings: &Findings) -> anyhow::Result<Vec<WantedCamera>> {
    let has_arm = wishes.robot != RobotChoice::None;
    let n_found = findings.cameras.len();
    if n_found > MAX_CAMERAS {
        return Ok(Vec::new());
    }
    let mut cameras = Vec::new();
    for ix in 0..n_found.max(1) {
        let name = findings
            .cameras
            .get(ix)
            .map_or("the camera".to_owned(), ToString::to_string);
        let places = if has_arm {
            "flange, base or world"
        } else {
            "base or world"
        };
        let default = default_parent(ix, has_arm, wishes.has_moving_base).name();
        let question = format!("Where is {name}: {places}");
        let place = answer(&question, default, |text| {
            let parent = parent(text).map_err(anyhow::Error::msg)?;
            anyhow::ensure!(has_arm || parent != Parent::Flange, "the robot has no arm");
            Ok(parent)
        })?;
        cameras.push(WantedCamera {
            parent: place,
            device: None,
        });
    }
    Ok(cameras)
}

/// Asks one question on stderr. An empty answer, or the end of the input, is the default. After an
/// invalid answer, the question is repeated.
///
/// # Errors
/// If the input cannot be read, or if all answers are invalid.
fn answer<T>(
    question: &str,
    default: &str,
    read: impl Fn(&str) -> anyhow::Result<T>,
) -> anyhow::Result<T> {
    answer_from(&mut std::io::stdin().lock(), question, default, read)
}

/// Reads the answers of [`answer`] from `input`.
fn answer_from<T>(
    input: &mut impl BufRead,
    question: &str,
    default: &str,
    read: impl Fn(&str) -> anyhow::Result<T>,
) -> anyhow::Result<T> {
    for _ in 0..MAX_ATTEMPTS {
        if default.is_empty() {
            print::notice(format_args!("{question}:"));
        } else {
            print::notice(format_args!("{question} [{default}]:"));
        }
        // The question must be visible before the program waits.
        print::flush();
        let mut line = String::new();
        input
            .read_line(&mut line)
            .context("cannot read the answer")?;
        let text = match line.trim() {
            "" => default,
            text => text,
        };
        match read(text) {
            Ok(value) => return Ok(value),
            Err(error) => print::notice(format_args!("{error:#}")),
        }
    }
    Err(BadInput(format!(
        "{question}: {MAX_ATTEMPTS} invalid answers; nothing was written"
    ))
    .into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_default_replaces_no_answer() {
        let robot = |answers: &str| {
            let read = |text: &str| Ok(RobotChoice::named(text)?);
            answer_from(&mut answers.as_bytes(), "Robot", "ur5e", read)
        };
        let is_named = |choice: RobotChoice, name: &str| matches!(choice, RobotChoice::Known(robot) if robot.name == name);
        for (answers, name) in [("", "ur5e"), ("\n", "ur5e"), ("ur5\npanda\n", "panda")] {
            assert!(
                is_named(robot(answers).expect(answers), name),
                "{answers:?}"
            );
        }
        let error = robot("ur5\nur5\nur5\n")
            .expect_err("no known robot")
            .to_string();
        assert!(error.contains("nothing was written"), "{error}");
    }
}
