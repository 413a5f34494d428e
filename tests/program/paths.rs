//! Checks that source files do not set the paths of their modules.
//!
//! Such a path can lead into another package, whose dependencies then have to be repeated, and hides
//! from the reader which crate a file belongs to.

use std::path::{Path, PathBuf};

/// All source files in a folder and its subfolders, without build outputs and hidden folders.
fn source_files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).expect("a folder") {
            let entry = entry.expect("an entry");
            let path = entry.path();
            let name = entry.file_name();
            let name = name.to_string_lossy();
            // Links are not followed, because they may lead out of the project.
            let is_folder = entry.file_type().expect("a type").is_dir();
            if is_folder && !name.starts_with('.') && name != "target" && name != "node_modules" {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") && path.is_file()
            {
                found.push(path);
            }
        }
    }
    found
}

/// Lines that set the path of a module.
fn lines_with_path(text: &str) -> impl Iterator<Item = &str> {
    // The text is in two parts, so that this file has no such line.
    let attribute = concat!("#[", "path");
    text.lines().filter(move |line| line.contains(attribute))
}

#[test]
fn modules_are_where_their_names_say() {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR"));
    let files = source_files(workspace);
    assert!(files.len() > 100, "{} source files", files.len());
    let mut found = Vec::new();
    for path in files {
        let text = std::fs::read_to_string(&path).expect("a text");
        for line in lines_with_path(&text) {
            found.push(format!("{}: {}", path.display(), line.trim()));
        }
    }
    assert_eq!(found, Vec::<String>::new());
}

#[test]
fn path_of_a_module_is_detected() {
    let attribute = concat!("    #[", "path = \"../other.rs\"]");
    let text = format!("mod first;\n{attribute}\nmod second;\n");
    assert_eq!(lines_with_path(&text).collect::<Vec<_>>(), [attribute]);
}
