//! Files of rendered images and their depth.

use anyhow::Context;
use messages::{BadInput, Setting};
use std::path::{Path, PathBuf};
use trainer::Picture;

/// File names of an image and its depth.
fn files(folder: &Path, ix: usize) -> [PathBuf; 2] {
    [
        folder.join(format!("{ix:05}.png")),
        folder.join(format!("{ix:05}_depth.npy")),
    ]
}

/// Rejects a folder that already holds any of the `n` images or their depth.
///
/// # Errors
///
/// If the folder holds such a file.
pub(crate) fn check_no_overwrite(folder: &Path, n: usize) -> Result<(), BadInput> {
    match (0..n)
        .flat_map(|ix| files(folder, ix))
        .find(|file| file.exists())
    {
        Some(file) => Err(BadInput(format!(
            "{}: {} exists; choose another folder",
            Setting::Out,
            file.display()
        ))),
        None => Ok(()),
    }
}

/// Writes an image and optionally its depth; returns their files.
///
/// * `ix`: index of the image, which names the files.
pub(crate) fn write(
    folder: &Path,
    ix: usize,
    picture: &Picture,
    with_depth: bool,
) -> anyhow::Result<(PathBuf, Option<PathBuf>)> {
    let [file, depth] = files(folder, ix);
    files::create_from(&file, |inside| write_png(inside, picture))
        .with_context(|| format!("cannot write {}", file.display()))?;
    let depth = with_depth.then_some(depth);
    if let Some(depth) = &depth {
        files::create(depth, |file| write_npy(file, picture))
            .with_context(|| format!("cannot write {}", depth.display()))?;
    }
    Ok((file, depth))
}

fn write_png(file: &Path, picture: &Picture) -> anyhow::Result<()> {
    let [width, height] = picture.size_px;
    Ok(image::save_buffer(
        file,
        &picture.rgba_srgb,
        width,
        height,
        image::ExtendedColorType::Rgba8,
    )?)
}

/// Writes depth as a `[height, width]` array of 32-bit floats.
fn write_npy(file: &mut std::fs::File, picture: &Picture) -> std::io::Result<()> {
    use npyz::WriterBuilder;
    let [width, height] = picture.size_px.map(u64::from);
    let to = std::io::BufWriter::new(file);
    let mut writer = npyz::WriteOptions::new()
        .default_dtype()
        .shape(&[height, width])
        .writer(to)
        .begin_nd()?;
    writer.extend(picture.depth_m.iter())?;
    writer.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_files_hold_the_rendered_depth() {
        let folder = tempfile::tempdir().expect("folder");
        let picture = Picture {
            size_px: [2, 3],
            rgba_srgb: vec![255; 24],
            depth_m: vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.5],
        };
        let (file, depth) = write(folder.path(), 7, &picture, true).expect("written");
        let bytes = std::fs::read(depth.expect("requested")).expect("a file");
        let read = npyz::NpyFile::new(&bytes[..]).expect("npy");
        assert_eq!(read.shape(), [3, 2]);
        assert_eq!(read.into_vec::<f32>().expect("floats"), picture.depth_m);
        assert!(file.ends_with("00007.png"));
        check_no_overwrite(folder.path(), 7).expect("the eighth image is not requested");
        let message = check_no_overwrite(folder.path(), 8)
            .expect_err("the file exists")
            .0;
        assert!(message.contains("00007.png exists"), "{message}");
    }
}
