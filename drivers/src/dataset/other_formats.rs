//! Recognizes data in the formats of other programs, so that the error can name the format and
//! explain what to do.

use std::path::Path;

/// A format that is not read.
struct OtherFormat {
    /// Name with its article.
    name: &'static str,
    /// Names of files and folders. A folder that contains one of them has this format.
    members: &'static [&'static str],
    /// Extensions, in lower case, of a file of this format, or of a file in a folder.
    extensions: &'static [&'static str],
    /// What to do.
    remedy: &'static str,
}

/// The formats. The first match is reported. A format that also contains files of another format
/// comes before the other format.
static OTHER_FORMATS: [OtherFormat; 7] = [
    OtherFormat {
        name: "a raw export of Polycam",
        members: &["keyframes/cameras", "keyframes/corrected_cameras"],
        extensions: &[],
        remedy: "convert it with `ns-process-data polycam` of nerfstudio",
    },
    OtherFormat {
        name: "an export of Record3D",
        members: &["EXR_RGBD", "rgbd"],
        extensions: &["r3d"],
        remedy: "export it as EXR and JPG sequence, and convert it with `ns-process-data record3d` of nerfstudio",
    },
    OtherFormat {
        name: "a LeRobot dataset",
        members: &["meta/info.json"],
        extensions: &[],
        remedy: "it has no camera poses: record the robot with `fieldrig record`, or write images and camera poses as transforms.json",
    },
    OtherFormat {
        name: "a ROS bag",
        members: &["metadata.yaml"],
        extensions: &["bag", "db3"],
        remedy: "convert its images and camera poses with scripts/datasets/ros_bag_to_tum.py",
    },
    OtherFormat {
        name: "a COLMAP model",
        members: &[
            "sparse",
            "colmap",
            "cameras.bin",
            "cameras.txt",
            "database.db",
        ],
        extensions: &[],
        remedy: "convert it with scripts/datasets/colmap_to_transforms.py",
    },
    OtherFormat {
        name: "a video without camera poses",
        members: &[],
        extensions: &["mp4", "mov", "mkv", "avi", "webm"],
        remedy: "estimate them with `ns-process-data video` of nerfstudio",
    },
    OtherFormat {
        name: "photos without camera poses",
        members: &["images"],
        extensions: &["jpg", "jpeg", "png", "heic"],
        remedy: "estimate them with `ns-process-data images` of nerfstudio",
    },
];

/// The end of an error message, which names the format of a file or folder and what to do. `None`
/// if the format is unknown.
pub(super) fn hint(path: &Path) -> Option<String> {
    let format = OTHER_FORMATS.iter().find(|format| format.matches(path))?;
    Some(format!(
        "; it looks like {}: {} (see docs/guide/data-from-elsewhere.md)",
        format.name, format.remedy
    ))
}

impl OtherFormat {
    fn matches(&self, path: &Path) -> bool {
        if path.is_file() {
            return self.has_extension(path);
        }
        self.members.iter().any(|name| path.join(name).exists()) || self.contains_file(path)
    }

    /// Whether a folder contains a file with one of the extensions.
    fn contains_file(&self, folder: &Path) -> bool {
        /// Maximum number of entries to examine, so that huge folders take little time.
        const MAX_ENTRIES: usize = 10_000;
        let Ok(entries) = std::fs::read_dir(folder) else {
            return false;
        };
        entries
            .take(MAX_ENTRIES)
            .flatten()
            .any(|entry| self.has_extension(&entry.path()))
    }

    fn has_extension(&self, file: &Path) -> bool {
        let extension = file.extension().and_then(|extension| extension.to_str());
        extension.is_some_and(|extension| {
            self.extensions
                .contains(&extension.to_ascii_lowercase().as_str())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder with one empty file.
    fn folder_with(file: &str) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "").unwrap();
        folder
    }

    #[test]
    fn formats_of_other_programs_are_named_with_a_remedy() {
        for (file, name, remedy) in [
            (
                "keyframes/corrected_cameras/1.json",
                "Polycam",
                "ns-process-data polycam",
            ),
            (
                "EXR_RGBD/metadata.json",
                "Record3D",
                "ns-process-data record3d",
            ),
            ("scan.r3d", "Record3D", "ns-process-data record3d"),
            ("meta/info.json", "LeRobot", "fieldrig record"),
            ("metadata.yaml", "ROS bag", "ros_bag_to_tum.py"),
            ("day.bag", "ROS bag", "ros_bag_to_tum.py"),
            ("sparse/0/cameras.bin", "COLMAP", "colmap_to_transforms.py"),
            ("cameras.txt", "COLMAP", "colmap_to_transforms.py"),
            ("walk.MP4", "video", "ns-process-data video"),
            ("images/1.jpg", "photos", "ns-process-data images"),
            ("1.JPG", "photos", "ns-process-data images"),
        ] {
            let folder = folder_with(file);
            let text = crate::dataset::read(folder.path()).unwrap_err().to_string();
            assert!(
                text.contains("expected transforms.json")
                    && text.contains(name)
                    && text.contains(remedy)
                    && text.contains("docs/guide/data-from-elsewhere.md"),
                "{file}: {text}"
            );
        }
        for file in ["scan.r3d", "day.bag", "bag_0.db3", "walk.mp4"] {
            let folder = folder_with(file);
            let text = crate::dataset::read(&folder.path().join(file))
                .unwrap_err()
                .to_string();
            assert!(
                text.contains("not a recording (.mcap)") && text.contains("it looks like"),
                "{file}: {text}"
            );
        }
        assert_eq!(hint(folder_with("notes.txt").path()), None);
    }

    #[test]
    fn formats_are_documented() {
        let page = include_str!("../../../docs/guide/data-from-elsewhere.md");
        for format in &OTHER_FORMATS {
            assert!(
                page.contains(&format!("| {} |", format.name)),
                "{}",
                format.name
            );
        }
    }
}
