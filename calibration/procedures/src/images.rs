//! Reads image files, and detects a target in images.

use crate::host::Host;
use calibration::{BoardPoint, BoardView};
use capture::CalibrationImage;
use image::ImageReader;
use messages::{BadInput, Setting};
use rayon::prelude::*;
use report::calibration_report::{Photo, Photos, Unused};
use session::ReadProgress;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use targets::{Counts, Detection, GrayImage, TargetSpec};

/// The target in one image.
#[derive(Debug)]
pub(crate) struct DetectedImage {
    /// Name of the file, or time in the recording.
    pub(crate) name: String,
    /// The target, or the reason why it was not found.
    pub(crate) board: Result<Board, NoBoard>,
}

/// The target in an image of known size.
#[derive(Debug)]
pub(crate) struct Board {
    pub(crate) size_px: [u32; 2],
    pub(crate) view: BoardView,
}

/// Why an image has no target.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NoBoard {
    /// The file is not an image, or damaged.
    #[error("cannot read the image: {0}")]
    Unreadable(String),
    /// The image can be read but does not show the target.
    #[error(transparent)]
    NotDetected(#[from] targets::NotDetected),
}

impl NoBoard {
    /// The image with this reason, for reports and messages.
    pub(crate) fn unused(&self, name: String) -> Unused {
        Unused {
            name,
            reason: self.to_string(),
            is_unreadable: matches!(self, Self::Unreadable(_)),
        }
    }
}

/// An image file and the name that messages use for it.
#[derive(Clone, Debug)]
pub(crate) struct ImageFile {
    pub(crate) name: String,
    pub(crate) path: PathBuf,
}

/// Extensions of the image files in a folder that are read.
const EXTENSIONS: [&str; 3] = ["jpg", "jpeg", "png"];

/// The image files in a folder, in order of their names.
pub(crate) fn files(folder: &Path) -> Result<Vec<ImageFile>, BadInput> {
    // Users may pass a single image by mistake. Without this check, the error would describe a
    // problem with a folder.
    if folder.is_file() {
        return Err(BadInput(format!(
            "{} is a file, expected a folder of images",
            folder.display()
        )));
    }
    let unreadable = |error: std::io::Error| unreadable_folder(folder, &error);
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        if is_image(&path) {
            let name = path
                .file_name()
                .unwrap_or(path.as_os_str())
                .to_string_lossy()
                .into_owned();
            files.push(ImageFile { name, path });
        }
    }
    // The order of a folder differs between file systems, and reports list images in this order.
    files.sort_by(|a, b| a.path.cmp(&b.path));
    if files.is_empty() {
        return Err(BadInput(format!(
            "{}: no .jpg, .jpeg or .png image",
            folder.display()
        )));
    }
    Ok(files)
}

fn unreadable_folder(folder: &Path, error: &std::io::Error) -> BadInput {
    BadInput(format!(
        "cannot read the folder {}: {error}",
        folder.display()
    ))
}

/// Whether a file has the extension of an image. Other files in the folder are ignored.
fn is_image(path: &Path) -> bool {
    path.extension().is_some_and(|extension| {
        EXTENSIONS
            .iter()
            .any(|known| extension.eq_ignore_ascii_case(known))
    })
}

/// Detects a target in image files, on all processors. The results are in the order of the files. A
/// warning names images that cannot be read.
///
/// # Errors
/// Fails if no image can be read.
pub(crate) fn detect(
    files: &[ImageFile],
    target: &TargetSpec,
    host: &dyn Host,
) -> Result<Vec<DetectedImage>, BadInput> {
    let detected = detect_each(files, host, |ImageFile { name, path }| DetectedImage {
        name: name.clone(),
        board: detect_in_file(path, name, target),
    });
    check_readable(&detected)?;
    Ok(detected)
}

/// Calls a function for each image, on all processors. The results are in the order of the images.
pub(crate) fn detect_each<T: Sync>(
    images: &[T],
    host: &dyn Host,
    detect: impl Fn(&T) -> DetectedImage + Sync,
) -> Vec<DetectedImage> {
    let n_done = AtomicUsize::new(0);
    host.on_progress(searched(0, images.len()));
    let detected = images.par_iter().map(|image| {
        let detected = detect(image);
        let n_done = 1 + n_done.fetch_add(1, Ordering::Relaxed);
        host.on_progress(searched(n_done, images.len()));
        detected
    });
    let detected = detected.collect();
    host.on_progress_end();
    detected
}

fn searched(n_done: usize, n_all: usize) -> ReadProgress {
    ReadProgress {
        noun: "images",
        n_done,
        n_all: Some(n_all),
    }
}

fn check_readable(images: &[DetectedImage]) -> Result<(), BadInput> {
    let unreadable: Vec<(&str, &NoBoard)> = images
        .iter()
        .filter_map(|image| Some((image.name.as_str(), image.board.as_ref().err()?)))
        .filter(|(_, reason)| matches!(reason, NoBoard::Unreadable(_)))
        .collect();
    let Some((first, reason)) = unreadable.first() else {
        return Ok(());
    };
    // A few damaged files must not end a calibration of many images.
    if unreadable.len() == images.len() {
        return Err(BadInput(format!(
            "none of {} images can be read; {first}: {reason}",
            images.len()
        )));
    }
    let names: Vec<&str> = unreadable.iter().map(|(name, _)| *name).collect();
    log::warn!(
        "{} of {} images cannot be read and are skipped: {}",
        names.len(),
        images.len(),
        names.join(", ")
    );
    Ok(())
}

/// A chessboard whose size differs from the size of the target.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct OtherSize {
    /// What the images show, and what to do.
    pub(crate) text: String,
    /// Whether more images show the other size than the size of the target.
    pub(crate) prevails: bool,
}

/// The board size that several images show instead of the size of the target.
pub(crate) fn other_size<'a>(
    images: impl Iterator<Item = &'a DetectedImage>,
    target: &TargetSpec,
) -> Option<OtherSize> {
    /// Fewer images may show a part of the board.
    const MIN_IMAGES: usize = 3;
    let mut n_images = 0;
    let mut n_detected = 0;
    let mut found_sizes: Vec<(Counts, usize)> = Vec::new();
    for image in images {
        n_images += 1;
        match &image.board {
            Ok(_) => n_detected += 1,
            Err(NoBoard::NotDetected(targets::NotDetected::OtherSize { found, .. })) => {
                // Few different sizes occur, so a list is enough.
                match found_sizes.iter_mut().find(|(size, _)| size == found) {
                    Some((_, n)) => *n += 1,
                    None => found_sizes.push((*found, 1)),
                }
            }
            Err(_) => (),
        }
    }
    // The most frequent other size is used, because a wrong detection in a single image may give
    // any size.
    let (found, n) = found_sizes
        .into_iter()
        .max_by_key(|(_, n)| *n)
        .filter(|(_, n)| *n >= MIN_IMAGES)?;
    let given = target.to_string();
    let parts: Vec<&str> = given.split(':').collect();
    let remedy = match parts[..] {
        ["chessboard", _, square] => {
            format!("use {} chessboard:{found}:{square}", Setting::Target)
        }
        _ => format!("check the counts of {}", Setting::Target),
    };
    let prevails = n > n_detected;
    let others = match n_detected {
        0 => String::new(),
        _ => format!(
            ", {n_detected} images seem to show a board of the given size, which may be a part of it"
        ),
    };
    let text = format!(
        "{n} of {n_images} images show a board with {found} inner corners, not {given}{others}; {remedy}"
    );
    Some(OtherSize { text, prevails })
}

fn detect_in_file(path: &Path, name: &str, target: &TargetSpec) -> Result<Board, NoBoard> {
    let unreadable = |error: image::ImageError| NoBoard::Unreadable(error.to_string());
    let reader = files::open(path)
        .map(BufReader::new)
        // The format is determined from the contents, because the extension may be wrong.
        .and_then(|file| ImageReader::new(file).with_guessed_format());
    let gray = reader
        .map_err(|error| unreadable(error.into()))?
        .decode()
        .map_err(unreadable)?
        .into_luma8();
    let size_px = [gray.width(), gray.height()];
    detect_in_gray(
        GrayImage {
            size_px,
            pixels: gray.as_raw(),
        },
        name,
        target,
    )
}

/// Detects a target in an image of a device or recording.
pub(crate) fn detect_in_image(image: &CalibrationImage, target: &TargetSpec) -> DetectedImage {
    let name = format!("image at {:.3} s", image.secs);
    let gray = GrayImage {
        size_px: image.size_px,
        pixels: &image.gray,
    };
    let board = detect_in_gray(gray, &name, target);
    DetectedImage { name, board }
}

/// Detects a target in an image. `name` is used in messages.
pub(crate) fn detect_in_gray(
    image: GrayImage<'_>,
    name: &str,
    target: &TargetSpec,
) -> Result<Board, NoBoard> {
    Ok(Board {
        size_px: image.size_px,
        view: view(name, &target.detect(image)?),
    })
}

fn view(name: &str, detection: &Detection) -> BoardView {
    let points = detection.corners.iter();
    let points = points.map(|corner| BoardPoint {
        point_in_board: corner.point_in_board,
        pixel: corner.pixel,
    });
    BoardView {
        name: name.to_owned(),
        points: points.collect(),
    }
}

/// The files of images, for a report.
pub(crate) fn photos(files: &[ImageFile]) -> Photos {
    files
        .iter()
        .map(|file| (file.name.clone(), Photo::File(file.path.clone())))
        .collect()
}

/// The images without the target, for a report.
pub(crate) fn unused(images: &[DetectedImage]) -> Vec<Unused> {
    let reason =
        |image: &DetectedImage| Some(image.board.as_ref().err()?.unused(image.name.clone()));
    images.iter().filter_map(reason).collect()
}
