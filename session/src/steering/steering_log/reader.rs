//! Reads a steering log, also if its program was killed.

use super::line::{Line, VERSION};
use flate2::bufread::GzDecoder;
use messages::BadInput;
use serde::Deserialize;
use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::path::{Path, PathBuf};

/// Maximum size of the lines in a member. Members end at 1 MiB, but the line of the robot
/// description may be longer.
const MAX_MEMBER_BYTES: u64 = 128 << 20;

/// The lines of one file.
pub(super) struct LogReader {
    path: PathBuf,
    file: BufReader<File>,
    lines: VecDeque<Line>,
    is_first: bool,
    /// Whether nothing more can be read.
    has_ended: bool,
    damage: Option<String>,
    other_version: Option<u64>,
}

/// A start of any version. In version 1, bases had a start of their own.
#[derive(Deserialize)]
struct AnyStart {
    #[serde(alias = "base_start")]
    start: AnyVersion,
}

#[derive(Deserialize)]
struct AnyVersion {
    version: u64,
}

impl LogReader {
    /// Opens a file.
    ///
    /// # Errors
    ///
    /// If it cannot be read, or is not a steering log of this version.
    pub(super) fn open(path: &Path) -> anyhow::Result<Self> {
        let file = files::open(path)
            .map_err(|error| BadInput(format!("cannot read {}: {error}", path.display())))?;
        let mut reader = Self {
            path: path.to_owned(),
            file: BufReader::new(file),
            lines: VecDeque::new(),
            is_first: true,
            has_ended: false,
            damage: None,
            other_version: None,
        };
        reader.read_member()?;
        Ok(reader)
    }

    /// The next line; `None` at the end, or where the file is damaged.
    pub(super) fn next(&mut self) -> anyhow::Result<Option<Line>> {
        while self.lines.is_empty() && !self.has_ended {
            self.read_member()?;
        }
        Ok(self.lines.pop_front())
    }

    /// Why the file could not be read to its end. A program that was killed leaves an incomplete
    /// file, which is not damaged.
    pub(super) fn damage(&self) -> Option<&str> {
        self.damage.as_deref()
    }

    fn read_member(&mut self) -> anyhow::Result<()> {
        if self.file.fill_buf().map(<[u8]>::is_empty)? {
            self.has_ended = true;
            return self.expect_start();
        }
        let mut text = Vec::new();
        let decoder = GzDecoder::new(&mut self.file);
        let read = decoder.take(MAX_MEMBER_BYTES + 1).read_to_end(&mut text);
        match read {
            Ok(n_bytes) if n_bytes as u64 > MAX_MEMBER_BYTES => {
                self.end("a part of it is too large".to_owned());
            }
            Ok(_) => self.parse(&text),
            // The rest is missing. All complete lines are used.
            Err(error) if error.kind() == ErrorKind::UnexpectedEof => {
                let n_complete = text.iter().rposition(|byte| *byte == b'\n');
                self.parse(&text[..n_complete.map_or(0, |ix| ix + 1)]);
                self.has_ended = true;
            }
            // A wrong checksum: none of the lines can be trusted.
            Err(error) => self.end(error.to_string()),
        }
        self.expect_start()
    }

    fn parse(&mut self, text: &[u8]) {
        for line in text
            .split(|byte| *byte == b'\n')
            .filter(|line| !line.is_empty())
        {
            if self.is_foreign(line) {
                return;
            }
            match serde_json::from_slice(line) {
                Ok(line) => self.lines.push_back(line),
                Err(error) => {
                    self.end(format!("a line is not valid: {error}"));
                    return;
                }
            }
        }
    }

    fn end(&mut self, damage: String) {
        self.has_ended = true;
        self.damage = Some(damage);
    }

    /// Whether a line is a start of another version, which may have other fields.
    fn is_foreign(&mut self, line: &[u8]) -> bool {
        let is_start = [&b"{\"start\""[..], b"{\"base_start\""]
            .iter()
            .any(|start| line.starts_with(start));
        let start = is_start.then_some(line);
        let version = start.and_then(|line| serde_json::from_slice(line).ok());
        let version = version.map(|any: AnyStart| any.start.version);
        self.other_version = version.filter(|version| *version != VERSION);
        self.other_version.is_some()
    }

    /// Checks the version, and that the first line is a start.
    fn expect_start(&mut self) -> anyhow::Result<()> {
        let shown = self.path.display();
        if let Some(version) = self.other_version {
            return Err(BadInput(format!(
                "{shown} is a steering log of format {version}, but this program reads format {VERSION}: \
                 use the version of fieldrig that wrote it"
            ))
            .into());
        }
        let is_log = matches!(self.lines.front(), Some(Line::Start(_)));
        if std::mem::replace(&mut self.is_first, false) && !is_log {
            let why = match &self.damage {
                Some(damage) => damage.as_str(),
                None if self.lines.is_empty() => "it is empty",
                None => "its first line is not a start",
            };
            return Err(BadInput(format!("{shown} is not a steering log: {why}")).into());
        }
        Ok(())
    }
}
