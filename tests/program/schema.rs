//! Tests that the committed JSON schema of rig files is the one that the program prints.

use crate::command::{fieldrig, stderr};
use std::path::Path;

#[test]
fn committed_schema_is_the_output_of_the_program() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = fieldrig(root, &["schema"]);
    assert!(output.status.success(), "{}", stderr(&output));
    let committed = std::fs::read(root.join("docs/reference/rig.schema.json")).expect("committed");
    assert!(
        output.stdout == committed,
        "run: cargo run --release -- schema > docs/reference/rig.schema.json"
    );
}
