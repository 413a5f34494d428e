//! A folder in which the images of a calibration are saved as they are taken.

use anyhow::Context;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};
use messages::{BadInput, Setting};
use std::path::{Path, PathBuf};

/// The folder. The images in it can be calibrated again with the same result, because targets are
/// detected in gray images.
#[derive(Debug)]
pub(crate) struct SavedImages {
    folder: PathBuf,
    n_images: usize,
}

impl SavedImages {
    /// Creates the folder, or uses an empty one.
    pub(crate) fn create(folder: &Path) -> anyhow::Result<Self> {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot create the folder {}", folder.display()))?;
        // Other images in the folder would be part of the next calibration.
        let mut entries = std::fs::read_dir(folder)
            .with_context(|| format!("cannot read the folder {}", folder.display()))?;
        if entries.next().is_some() {
            return Err(BadInput(format!(
                "{} {}: the folder is not empty; choose another one",
                Setting::SaveImages,
                folder.display()
            ))
            .into());
        }
        Ok(Self {
            folder: folder.to_owned(),
            n_images: 0,
        })
    }

    /// Saves an image.
    ///
    /// * `gray`: gray values, row by row.
    pub(crate) fn save(&mut self, [width, height]: [u32; 2], gray: &[u8]) -> anyhow::Result<()> {
        let path = self
            .folder
            .join(format!("image-{:03}.png", self.n_images + 1));
        let mut png = Vec::new();
        PngEncoder::new(&mut png)
            .write_image(gray, width, height, ExtendedColorType::L8)
            .with_context(|| format!("cannot encode {}", path.display()))?;
        files::write(&path, png).with_context(|| format!("cannot write {}", path.display()))?;
        self.n_images += 1;
        Ok(())
    }

    /// Logs how many images were saved.
    pub(crate) fn report(&self) {
        let n = messages::counted(self.n_images as u64, "image");
        log::info!("{n} saved in {}", self.folder.display());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::images;

    #[test]
    fn saved_images_are_found_again_and_a_full_folder_is_refused() {
        let root = tempfile::tempdir().expect("a folder");
        let folder = root.path().join("new/photographs");
        let mut saved = SavedImages::create(&folder).expect("a new folder");
        for shade in [10, 200] {
            saved
                .save([4, 3], &[shade; 12])
                .expect("the disk has space");
        }
        let files = images::files(&folder).expect("images");
        let names: Vec<&str> = files.iter().map(|file| &*file.name).collect();
        assert_eq!(names, ["image-001.png", "image-002.png"]);
        let second = image::open(&files[1].path)
            .expect("a PNG file")
            .into_luma8();
        assert_eq!((second.dimensions(), second.as_raw()[0]), ((4, 3), 200));
        let error = SavedImages::create(&folder).expect_err("it has images");
        assert!(error.to_string().contains("not empty"), "{error}");
    }
}
