//! Reads curves measured with other trainers. The files are JSON with `rows` of `seconds` and
//! `psnr`.

use anyhow::Result;
use messages::{BadInput, Setting};
use serde::Deserialize;
use std::path::Path;

/// Curve of another trainer.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Peer {
    /// Name of the file without its extension.
    pub(crate) label: String,
    pub(crate) rows: Vec<Row>,
}

/// One point of a curve.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(crate) struct Row {
    pub(crate) seconds: f64,
    pub(crate) psnr: f64,
    /// Number of primitives, if given.
    pub(crate) n: Option<u64>,
    /// Bytes of the model, if given.
    pub(crate) bytes: Option<u64>,
}

#[derive(Deserialize)]
struct File {
    rows: Vec<Row>,
}

impl Peer {
    /// Reads a file.
    ///
    /// # Errors
    ///
    /// Fails if the file is unreadable or has another format.
    pub(crate) fn load(path: &Path) -> Result<Self> {
        let invalid =
            |reason: &str| BadInput(format!("{} {}: {reason}", Setting::Peer, path.display()));
        let text = files::read_text(path)
            .map_err(|error| invalid(&format!("cannot be read ({error})")))?;
        let file: File = serde_json::from_str(&text).map_err(|error| {
            invalid(&format!(
                "expected an object with rows of seconds and psnr ({error})"
            ))
        })?;
        // The time axis of the charts is logarithmic.
        if file.rows.is_empty() || file.rows.iter().any(|row| row.seconds <= 0.0) {
            return Err(invalid("expected at least one row, and seconds above 0 in each").into());
        }
        let label = path.file_stem().map_or_else(
            || "peer".to_owned(),
            |stem| stem.to_string_lossy().into_owned(),
        );
        let mut rows = file.rows;
        rows.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
        Ok(Self { label, rows })
    }

    /// Points `(seconds, dB)`.
    pub(crate) fn curve(&self) -> Vec<(f64, f64)> {
        self.rows
            .iter()
            .map(|row| (row.seconds, row.psnr))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn peer_curve_is_parsed_and_invalid_files_are_reported() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("gsplat_fox.json");
        let write = |text: &str| std::fs::write(&path, text).expect("written");
        write(
            r#"{"args": {"seed": 0}, "rows": [{"seconds": 1.0, "step": 9, "psnr": 12.4, "ssim": 0.6, "n": 7, "bytes": 1652}, {"seconds": 0.5, "psnr": 11.0}]}"#,
        );
        let peer = Peer::load(&path).expect("a curve");
        assert_eq!(
            (peer.label.as_str(), peer.rows[1].n, peer.rows[1].bytes),
            ("gsplat_fox", Some(7), Some(1652))
        );
        assert_eq!(peer.curve(), [(0.5, 11.0), (1.0, 12.4)]);
        for other in [
            "[]",
            r#"{"rows": []}"#,
            r#"{"rows": [{"seconds": 0.0, "psnr": 1.0}]}"#,
        ] {
            write(other);
            let message = Peer::load(&path).expect_err("no curve").to_string();
            assert!(message.contains("gsplat_fox.json"), "{message}");
        }
        assert!(
            Peer::load(Path::new("absent.json"))
                .expect_err("absent")
                .to_string()
                .contains("cannot be read")
        );
    }
}
