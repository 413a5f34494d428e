//! Reads image files and detects a target in them.

use crate::exit::BadArgument;
use crate::print;
use anyhow::Context;
use calibration::{BoardPoint, BoardView};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use targets::{Detection, GrayImage, TargetSpec};

/// The target in one image.
#[derive(Clone, Debug)]
pub(super) struct DetectedImage {
    /// Name of the file.
    pub(super) name: String,
    /// The target, or the reason why it was not found.
    pub(super) board: Result<Board, String>,
}

/// The target in an image of known size.
#[derive(Clone, Debug)]
pub(super) struct Board {
    pub(super) size_px: [u32; 2],
    pub(super) view: BoardView,
}

/// Extensions of the image files in a folder that are read.
const EXTENSIONS: [&str; 3] = ["jpg", "jpeg", "png"];

/// The image files in a folder, in order of their names.
pub(super) fn files(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    if folder.is_file() {
        return Err(BadArgument(format!("{} is a file, expected a folder of images", folder.display())).into());
    }
    let in_folder = || format!("cannot read the folder {}", folder.display());
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(in_folder)? {
        let path = entry.with_context(in_folder)?.path();
        let is_known =
            |extension: &std::ffi::OsStr| EXTENSIONS.iter().any(|known| extension.eq_ignore_ascii_case(known));
        if path.extension().is_some_and(is_known) {
            files.push(path);
        }
    }
    files.sort();
    if files.is_empty() {
        return Err(BadArgument(format!("{}: no .jpg, .jpeg or .png image", folder.display())).into());
    }
    Ok(files)
}

/// Detects a target in image files, on all processors; the results are in the order of the files. `is_hidden`: no
/// progress bar.
pub(super) fn detect(files: &[PathBuf], target: &TargetSpec, is_hidden: bool) -> Vec<DetectedImage> {
    detect_each(files, is_hidden, |path| {
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let board = detect_in(path, &name, target).map_err(|error| format!("{error:#}"));
        DetectedImage { name, board }
    })
}

/// Calls a function for each image, on all processors; the results are in the order of the images.
pub(super) fn detect_each<T: Sync>(
    images: &[T],
    is_hidden: bool,
    detect: impl Fn(&T) -> DetectedImage + Sync,
) -> Vec<DetectedImage> {
    let bar = print::bar(Some(images.len() as u64), "{bar:30} {pos} of {len} images", is_hidden);
    let next = AtomicUsize::new(0);
    let detect_some = || {
        let mut detected = Vec::new();
        loop {
            let ix = next.fetch_add(1, Ordering::Relaxed);
            let Some(image) = images.get(ix) else { return detected };
            detected.push((ix, detect(image)));
            bar.inc(1);
        }
    };
    let n_threads = std::thread::available_parallelism().map_or(1, |n| n.get().min(images.len()));
    let mut detected: Vec<_> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..n_threads).map(|_| scope.spawn(detect_some)).collect();
        threads.into_iter().flat_map(|thread| thread.join().expect("detection does not panic")).collect()
    });
    bar.finish_and_clear();
    detected.sort_by_key(|(ix, _)| *ix);
    detected.into_iter().map(|(_, image)| image).collect()
}

fn detect_in(path: &Path, name: &str, target: &TargetSpec) -> anyhow::Result<Board> {
    let read = || anyhow::Ok(image::ImageReader::open(path)?.with_guessed_format()?.decode()?.into_luma8());
    let gray = read().context("cannot read the image")?;
    let size_px = [gray.width(), gray.height()];
    detect_in_gray(GrayImage { size_px, pixels: gray.as_raw() }, name, target)
}

pub(super) fn detect_in_gray(gray: GrayImage<'_>, name: &str, target: &TargetSpec) -> anyhow::Result<Board> {
    Ok(Board { size_px: gray.size_px, view: view(name, &target.detect(gray)?) })
}

fn view(name: &str, detection: &Detection) -> BoardView {
    let points = detection.corners.iter();
    let points = points.map(|corner| BoardPoint { point_in_board: corner.point_in_board, pixel: corner.pixel });
    BoardView { name: name.to_owned(), points: points.collect() }
}
