//! Events and results of training as lines of text.

use crate::next_commands::{self, SavedModel};
use crate::observer::{Evaluation, FinishedReport, SessionProgress};
use crate::previous_run::FinishedRun;
use crate::session::FinishedModel;
use messages::{Setting, counted};
use viz::Verdict;

impl SessionProgress {
    /// The state of training in a few words.
    #[must_use]
    pub fn summary(&self) -> String {
        let psnr = self
            .psnr
            .map_or(String::new(), |psnr| format!(", {psnr:.2} dB"));
        let primitives = counted(self.progress.primitives, self.primitive);
        format!("step {}, {primitives}{psnr}", self.progress.step)
    }
}

impl Evaluation {
    /// The evaluation as one line.
    #[must_use]
    pub fn line(&self) -> String {
        format!(
            "{:7.2} s  step {:6}  {:>15}  {:7.2} ms/step  {}",
            self.seconds,
            self.step,
            counted(self.primitives, self.primitive),
            self.step_millis.unwrap_or_default(),
            self.scores.short()
        )
    }
}

impl FinishedReport<'_> {
    /// The result of training, and where it was saved.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let passes = self.profile.iter().flat_map(|profile| profile.passes);
        let mut lines: Vec<String> = passes
            .map(|(name, millis)| format!("{millis:9.3} ms  {name}"))
            .collect();
        let done = self.done;
        lines.extend(wrapped(&format!(
            "{:.1} s, {}, {}, {:.1} MB: {}",
            done.seconds,
            counted(done.steps, "step"),
            counted(done.primitives, self.primitive),
            done.bytes as f64 / 1e6,
            done.scores
        )));
        let with_page = if self.has_page {
            ", with pictures and scores in report.html"
        } else {
            ""
        };
        lines.push(format!("saved in {}{with_page}", done.out.display()));
        lines
    }
}

impl FinishedRun {
    /// Says that nothing is left to do, and how to continue.
    #[must_use]
    pub fn describe(&self) -> String {
        let Self {
            folder,
            seconds,
            limits,
        } = self;
        let limits = [
            limits
                .steps
                .map(|steps| format!("{} {steps}", Setting::Steps)),
            limits
                .seconds
                .map(|secs| format!("{} {secs}", Setting::Seconds)),
        ];
        let limits: Vec<String> = limits.into_iter().flatten().collect();
        let limits = if limits.is_empty() {
            String::new()
        } else {
            format!("{}, ", limits.join(" "))
        };
        format!(
            "nothing left to do: the run in {} is finished ({limits}{seconds:.1} s) and its model is saved there; \
             to continue it, use a larger {} or {}",
            folder.display(),
            Setting::Steps,
            Setting::Seconds
        )
    }
}

/// Commands to run next on these models, and the likely cause of a poor result. The last line is
/// the verdict on the models, with the first of these commands.
#[must_use]
pub fn end_lines(
    models: &[FinishedModel],
    likely_cause: Option<&str>,
    verdict: &Verdict,
) -> Vec<String> {
    let saved: Vec<SavedModel<'_>> = models.iter().map(FinishedModel::saved).collect();
    let commands = next_commands::for_models(&saved);
    let mut lines = next_commands::lines(&commands);
    lines.extend(likely_cause.map(|cause| format!("likely cause of the low PSNR: {cause}")));
    let first = commands.first();
    lines.extend(first.map(|first| format!("{}. Next: {}", verdict.text, first.command)));
    lines
}

/// Maximum length of the lines of [`wrapped`].
const MAX_LINE_CHARS: usize = 100;

/// A list that is broken after commas, if possible into lines of at most [`MAX_LINE_CHARS`]
/// characters. All lines except the first are indented.
fn wrapped(list: &str) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in list.split_inclusive(", ") {
        match lines.last_mut() {
            Some(line)
                if line.chars().count() + word.trim_end().chars().count() <= MAX_LINE_CHARS =>
            {
                line.push_str(word)
            }
            Some(_) => lines.push(format!("  {word}")),
            None => lines.push(word.to_owned()),
        }
    }
    lines
        .iter()
        .map(|line| line.trim_end().to_owned())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lists_are_wrapped_after_commas() {
        let words: Vec<String> = (0..30).map(|n| format!("score{n} 12.34 dB")).collect();
        let list = words.join(", ");
        let lines = wrapped(&list);
        assert!(lines.len() > 1 && lines.iter().all(|line| line.len() <= MAX_LINE_CHARS));
        assert!(lines[1..].iter().all(|line| line.starts_with("  score")));
        let joined: Vec<&str> = lines.iter().map(|line| line.trim()).collect();
        assert_eq!(joined.join(" "), list);
        assert_eq!(wrapped("one"), ["one"]);
    }
}
