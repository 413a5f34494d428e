//! Reads image files and detects a target in them.

use crate::exit::BadArgument;
use crate::print;
use anyhow::Context;
use calibration::{BoardPoint, BoardView};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use targets::{Detection, GrayImage, TargetSpec};

/// The target in one image.
#[derive(Debug)]
pub(super) struct DetectedImage {
    /// Name of the file.
    pub(super) name: String,
    pub(super) size_px: [u32; 2],
    /// The corners, or the reason why they were not found.
    pub(super) board: Result<BoardView, String>,
}

/// Extensions of the image files in a folder that are read.
const EXTENSIONS: [&str; 4] = ["jpg", "jpeg", "png", "JPG"];

/// The image files in a folder, in order of their names.
pub(super) fn files(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let in_folder = || format!("cannot read the folder {}", folder.display());
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(in_folder)? {
        let path = entry.with_context(in_folder)?.path();
        if path.extension().is_some_and(|extension| EXTENSIONS.iter().any(|known| extension == *known)) {
            files.push(path);
        }
    }
    files.sort();
    if files.is_empty() {
        return Err(BadArgument(format!("{}: no .jpg, .jpeg or .png image", folder.display())).into());
    }
    Ok(files)
}

/// Detects a target in image files, on all processors. `is_hidden`: no progress bar.
pub(super) fn detect(files: &[PathBuf], target: &TargetSpec, is_hidden: bool) -> anyhow::Result<Vec<DetectedImage>> {
    let bar = print::bar(Some(files.len() as u64), "{bar:30} {pos} of {len} images", is_hidden);
    let next = AtomicUsize::new(0);
    let detect_next = || {
        let mut detected = Vec::new();
        while let Some(path) = files.get(next.fetch_add(1, Ordering::Relaxed)) {
            detected.push((path.clone(), detect_in(path, target)));
            bar.inc(1);
        }
        detected
    };
    let n_threads = std::thread::available_parallelism().map_or(1, |n| n.get().min(files.len()));
    let mut detected: Vec<_> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..n_threads).map(|_| scope.spawn(detect_next)).collect();
        threads.into_iter().flat_map(|thread| thread.join().expect("detection does not panic")).collect()
    });
    bar.finish_and_clear();
    detected.sort_by(|(a, _), (b, _)| a.cmp(b));
    detected.into_iter().map(|(_, image)| image).collect()
}

fn detect_in(path: &Path, target: &TargetSpec) -> anyhow::Result<DetectedImage> {
    let read = || anyhow::Ok(image::ImageReader::open(path)?.with_guessed_format()?.decode()?.into_luma8());
    let gray = read().with_context(|| format!("cannot read the image {}", path.display()))?;
    let size_px = [gray.width(), gray.height()];
    let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    let board = target.detect(GrayImage { size_px, pixels: gray.as_raw() });
    let board = board.map(|detection| view(&name, &detection)).map_err(|error| error.to_string());
    Ok(DetectedImage { name, size_px, board })
}

fn view(name: &str, detection: &Detection) -> BoardView {
    let points = detection.corners.iter();
    let points = points.map(|corner| BoardPoint { point_in_board: corner.point_in_board, pixel: corner.pixel });
    BoardView { name: name.to_owned(), points: points.collect() }
}
