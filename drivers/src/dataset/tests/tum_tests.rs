//! Tests which parts of a TUM folder the reader uses, names in a message, or refuses.

use super::super::{Dataset, read};
use super::{save_counts, tum_folder};
use image::RgbImage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

const LISTS: [&str; 4] = ["rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt"];

fn rewrite(folder: &Path, list: &str, change: impl FnOnce(String) -> String) {
    let path = folder.join(list);
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(path, change(text)).unwrap();
}

fn replace(folder: &Path, list: &str, from: &str, to: &str) {
    rewrite(folder, list, |text| {
        assert!(text.contains(from), "{from} is not in {text}");
        text.replacen(from, to, 1)
    });
}

fn append(folder: &Path, list: &str, line: &str) {
    rewrite(folder, list, |text| format!("{text}{line}\n"));
}

/// Replaces a file by a folder, which cannot be read as a file.
fn make_unreadable(folder: &Path, list: &str) {
    std::fs::remove_file(folder.join(list)).unwrap();
    std::fs::create_dir(folder.join(list)).unwrap();
}

type Change = fn(&Path);

/// A row of the table in docs/reference/datasets.md, words that the message contains, and a change
/// to a folder.
const CASES: &[(&str, &str, Change)] = &[
    ("empty lines, lines that start with `#`", "", |folder| {
        for list in LISTS {
            rewrite(folder, list, |text| {
                format!("\n  # comment, 1 2 3\n\n{text}\n#end")
            });
        }
    }),
    ("byte order mark, line ends of Windows", "", |folder| {
        for list in LISTS {
            rewrite(folder, list, |text| {
                format!("\u{FEFF}{}", text.replace('\n', "\r\n"))
            });
        }
    }),
    ("commas or tabs between columns", "", |folder| {
        for (list, separator) in LISTS.into_iter().zip([",", "\t", ", ", ",\t"]) {
            rewrite(folder, list, |text| text.replace(' ', separator));
        }
    }),
    ("order of the lines", "", |folder| {
        for list in &LISTS[..3] {
            rewrite(folder, list, |text| {
                text.lines().rev().map(|line| format!("{line}\n")).collect()
            });
        }
    }),
    ("`rgb.txt`: time, path", "", |folder| {
        replace(folder, "rgb.txt", "1.100000 ", "1.101000 ")
    }),
    ("`rgb.txt`: time, path", "", |folder| {
        replace(folder, "rgb.txt", "1.100000 rgb/1.1", "1.100000 rgb/1.2")
    }),
    (
        "times with exponents or more than nine decimals",
        "",
        |folder| {
            replace(folder, "rgb.txt", "1.100000 ", "1.1e0 ");
            replace(folder, "groundtruth.txt", "1.0050 ", "+10050000000.9e-10 ");
        },
    ),
    (
        "line with another time",
        "line 2: \"noon\" is not a time in seconds",
        |folder| {
            replace(folder, "rgb.txt", "1.000000 ", "noon ");
        },
    ),
    (
        "line with another time",
        "\"1403636579763555584\" is not a time in seconds",
        |folder| {
            append(folder, "depth.txt", "1403636579763555584 depth/1.png");
        },
    ),
    (
        "line with nothing but a time",
        "line 7: nothing follows the time",
        |folder| append(folder, "rgb.txt", "1.15"),
    ),
    ("photo that does not exist", "rgb/gone.png", |folder| {
        replace(folder, "rgb.txt", "rgb/1.100000.png", "rgb/gone.png")
    }),
    (
        "photo that is not an image",
        "rgb/1.100000.png (not an image)",
        |folder| {
            std::fs::write(folder.join("rgb/1.100000.png"), "text").unwrap();
        },
    ),
    (
        "photo of another size",
        "rgb/1.100000.png (it has 4x3 pixels, but the lens parameters are for 8x6)",
        |folder| {
            RgbImage::new(4, 3)
                .save(folder.join("rgb/1.100000.png"))
                .unwrap();
        },
    ),
    (
        "second photo with the same time",
        "rgb/1.200000.png (another photo has the same time)",
        |folder| {
            replace(folder, "rgb.txt", "1.200000 ", "1.100000 ");
        },
    ),
    (
        "photo before the first or after the last pose",
        "rgb/1.100000.png (its time is before the first or",
        |folder| {
            replace(folder, "rgb.txt", "1.100000 ", "8.000000 ");
        },
    ),
    (
        "photo in a gap of the poses",
        "the poses before and after it are ",
        |folder| {
            rewrite(folder, "groundtruth.txt", |text| {
                text.lines()
                    .filter(|line| !line.starts_with("1.0") && !line.starts_with("1.1"))
                    .fold("1.0000 0 2 3 0 0 0 1\n".to_owned(), |kept, line| {
                        kept + line + "\n"
                    })
            });
        },
    ),
    (
        "`groundtruth.txt`: time, position, quaternion",
        "",
        |folder| {
            replace(folder, "groundtruth.txt", "1.0050 ", "1.0060 ");
        },
    ),
    (
        "`groundtruth.txt`: time, position, quaternion",
        "",
        |folder| {
            replace(
                folder,
                "groundtruth.txt",
                "1.0050 0.01 2 3 ",
                "1.0050 0.01 2 4 ",
            );
        },
    ),
    (
        "`groundtruth.txt`: time, position, quaternion",
        "",
        |folder| {
            replace(
                folder,
                "groundtruth.txt",
                "1.0050 0.01 2 3 0 0 0 1",
                "1.0050 0.01 2 3 0 0 0.6 0.8",
            );
        },
    ),
    ("quaternion with a length within 1 % of 1", "", |folder| {
        replace(
            folder,
            "groundtruth.txt",
            "1.0050 0.01 2 3 0 0 0 1",
            "1.0050 0.01 2 3 0 0 0 0.995",
        );
    }),
    (
        "other quaternion",
        "line 2: the pose is not finite, too far away, or its quaternion is not of length 1",
        |folder| {
            replace(
                folder,
                "groundtruth.txt",
                "1.0050 0.01 2 3 0 0 0 1",
                "1.0050 0.01 2 3 0 0 0 2",
            );
        },
    ),
    (
        "position that is not finite, or farther than 10 km",
        "line 2: the pose is not finite, too far away",
        |folder| {
            replace(folder, "groundtruth.txt", "1.0050 0.01 ", "1.0050 nan ");
        },
    ),
    (
        "position that is not finite, or farther than 10 km",
        "line 2: the pose is not finite, too far away",
        |folder| {
            replace(folder, "groundtruth.txt", "1.0050 0.01 ", "1.0050 10001 ");
        },
    ),
    (
        "pose with other columns",
        "line 2: expected seven numbers tx ty tz qx qy qz qw after the time",
        |folder| {
            replace(
                folder,
                "groundtruth.txt",
                "1.0050 0.01 2 3 0 0 0 1",
                "1.0050 0.01 2 3 0 0 0 1 7",
            );
        },
    ),
    (
        "pose with other columns",
        "line 2: expected seven numbers tx ty tz qx qy qz qw after the time",
        |folder| {
            replace(
                folder,
                "groundtruth.txt",
                "1.0050 0.01 2 ",
                "1.0050 0.01 two ",
            );
        },
    ),
    (
        "second, different pose with the same time",
        "an earlier, different pose has the same time",
        |folder| {
            append(folder, "groundtruth.txt", "1.0050 5 2 3 0 0 0 1");
        },
    ),
    (
        "no `groundtruth.txt`, or one that cannot be read",
        "groundtruth.txt",
        |folder| {
            std::fs::remove_file(folder.join("groundtruth.txt")).unwrap();
        },
    ),
    (
        "no `groundtruth.txt`, or one that cannot be read",
        "groundtruth.txt",
        |folder| {
            std::fs::write(folder.join("groundtruth.txt"), [0xFF, 0xFE, 0x31, 0x00]).unwrap();
        },
    ),
    ("`depth.txt`: time, path", "", |folder| {
        replace(folder, "depth.txt", "1.110000 ", "1.105000 ")
    }),
    ("`depth.txt`: time, path", "", |folder| {
        save_counts(&folder.join("depth/other.png"), [8, 6], &[4000; 48]);
        replace(folder, "depth.txt", "depth/1.110000.png", "depth/other.png");
    }),
    ("no `depth.txt`", "", |folder| {
        std::fs::remove_file(folder.join("depth.txt")).unwrap()
    }),
    ("`depth.txt` that cannot be read", "depth.txt", |folder| {
        make_unreadable(folder, "depth.txt")
    }),
    (
        "photo without depth within 20 ms",
        "2 photos have no depth image within 20 ms",
        |folder| {
            replace(folder, "depth.txt", "1.110000 ", "1.140000 ");
        },
    ),
    (
        "photo without depth within 20 ms",
        "3 photos have no depth image within 20 ms",
        |folder| {
            std::fs::write(folder.join("depth.txt"), "# none\n").unwrap();
        },
    ),
    (
        "depth image that does not exist",
        "1 depth image is missing: depth/gone.png",
        |folder| {
            replace(folder, "depth.txt", "depth/1.110000.png", "depth/gone.png");
        },
    ),
    (
        "depth image without a pose",
        "depth/1.110000.png (its time is before the first or after the last",
        |folder| {
            replace(folder, "rgb.txt", "1.200000 ", "1.240000 ");
            replace(folder, "depth.txt", "1.110000 ", "1.250000 ");
        },
    ),
    (
        "second depth image with the same time",
        "an earlier line has the same time; write times with more",
        |folder| {
            append(folder, "depth.txt", "1.110000 depth/1.015000.png");
        },
    ),
    ("`calibration.txt`: 4, 8 or 9 numbers", "", |folder| {
        replace(folder, "calibration.txt", "500 ", "510 ")
    }),
    ("`calibration.txt`: 4, 8 or 9 numbers", "", |folder| {
        append(folder, "calibration.txt", "0.1 0 0 0")
    }),
    ("`calibration.txt`: 4, 8 or 9 numbers", "", |folder| {
        append(folder, "calibration.txt", "0 0 0 0 0.1")
    }),
    (
        "`calibration.txt` with other contents",
        "5 numbers, expected fx fy cx cy",
        |folder| {
            append(folder, "calibration.txt", "0.1");
        },
    ),
    (
        "`calibration.txt` with other contents",
        "line 1: \"fx:\" is not a number",
        |folder| {
            replace(folder, "calibration.txt", "500 ", "fx: 500 ");
        },
    ),
    (
        "`calibration.txt` with other contents",
        "focal length x is NaN",
        |folder| {
            replace(folder, "calibration.txt", "500 ", "nan ");
        },
    ),
    (
        "`calibration.txt` that cannot be read",
        "calibration.txt",
        |folder| make_unreadable(folder, "calibration.txt"),
    ),
    ("other files, such as `accelerometer.txt`", "", |folder| {
        std::fs::write(folder.join("accelerometer.txt"), "1.0 0 0 9.8\n").unwrap();
    }),
];

/// Changes one part of a folder at a time, and compares the effect with the table in
/// docs/reference/datasets.md.
#[test]
fn parts_of_tum_folders_are_used_refused_or_named_as_documented() {
    let page = include_str!("../../../../docs/reference/datasets.md");
    let section = page
        .split("\n## ")
        .find(|section| section.starts_with("TUM RGB-D"));
    let rows = section.expect("a section").lines().filter_map(|line| {
        let mut cells = line.strip_prefix("| ")?.split(" | ");
        Some((cells.next()?, cells.next()?))
    });
    let documented: BTreeMap<&str, &str> = rows.filter(|(part, _)| *part != "part").collect();
    let tested: BTreeSet<&str> = CASES.iter().map(|(part, ..)| *part).collect();
    assert_eq!(documented.keys().copied().collect::<BTreeSet<_>>(), tested);
    let messages = |dataset: &Dataset| [&dataset.notes[..], &dataset.data_losses].concat();
    for (part, words, change) in CASES {
        let folder = tum_folder();
        let unchanged = read(folder.path()).unwrap();
        change(folder.path());
        let changed = read(folder.path());
        let context = format!("{part}: {words}: {changed:#?}");
        if documented[part] == "refused" {
            let error = changed.expect_err(&context);
            assert!(error.to_string().contains(words), "{error}");
            continue;
        }
        let changed = changed.unwrap_or_else(|error| panic!("{part}: {error}"));
        let is_named = messages(&changed)
            .iter()
            .any(|message| message.contains(words));
        let was_named = messages(&unchanged)
            .iter()
            .any(|message| message.contains(words));
        let is_same = changed.images == unchanged.images;
        match documented[part] {
            "yes" => assert!(!is_same, "{context}"),
            "no" => assert!(
                is_same && messages(&changed) == messages(&unchanged),
                "{context}"
            ),
            "note" => assert!(is_named && !was_named, "{context}"),
            other => panic!("{part}: unknown use {other:?}"),
        }
    }
}

#[test]
fn paths_may_have_spaces_and_backslashes() {
    let folder = tum_folder();
    RgbImage::new(8, 6)
        .save(folder.path().join("rgb/a  b, c.png"))
        .unwrap();
    let list = "1.000000,rgb/a  b, c.png\n1.100000\t rgb\\1.100000.png\n";
    std::fs::write(folder.path().join("rgb.txt"), list).unwrap();
    let depths = "1.000000 depth\\1.015000.png\n";
    std::fs::write(folder.path().join("depth.txt"), depths).unwrap();
    let dataset = read(folder.path()).unwrap();
    let paths: Vec<_> = dataset
        .images
        .iter()
        .map(|image| image.image_path.clone())
        .collect();
    assert_eq!(
        paths,
        ["rgb/a  b, c.png", "rgb/1.100000.png"].map(|name| folder.path().join(name))
    );
    assert_eq!(
        dataset.images[0].load().unwrap().depth.unwrap().depth_m,
        [1.0; 48]
    );
}

#[test]
fn lens_of_the_benchmark_is_used_for_its_image_size_only() {
    let folder = tum_folder();
    let named = folder.path().join("rgbd_dataset_freiburg3_office");
    std::fs::create_dir(&named).unwrap();
    for name in ["rgb", "rgb.txt", "groundtruth.txt"] {
        std::fs::rename(folder.path().join(name), named.join(name)).unwrap();
    }
    for (photo, size_px) in [
        ("1.000000", [640, 480]),
        ("1.100000", [320, 240]),
        ("1.200000", [640, 480]),
    ] {
        RgbImage::new(size_px[0], size_px[1])
            .save(named.join(format!("rgb/{photo}.png")))
            .unwrap();
    }
    let dataset = read(&named).unwrap();
    assert_eq!(dataset.images.len(), 2);
    let expected =
        "rgb/1.100000.png (it has 320x240 pixels, but the lens parameters are for 640x480)";
    assert_eq!(
        dataset.data_losses,
        [format!("1 image cannot be used: {expected}")]
    );
    for photo in ["1.000000", "1.200000"] {
        RgbImage::new(320, 240)
            .save(named.join(format!("rgb/{photo}.png")))
            .unwrap();
    }
    let error = read(&named).unwrap_err().to_string();
    assert!(
        error.contains("320x240 pixels, but the lens parameters are for 640x480"),
        "{error}"
    );
}
