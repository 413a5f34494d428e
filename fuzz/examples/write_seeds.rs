//! Writes the generated seeds to the folder `seeds`. Run it after a format change. Seeds found by
//! fuzzing and recordings compressed by other programs are kept, because they have other names.
//!
//! ```text
//! RUSTFLAGS="--cfg fuzzing" cargo run --manifest-path fuzz/Cargo.toml --example write_seeds
//! ```

use drivers::fuzz::{Seed, generated_seeds};
use std::path::Path;

fn main() -> std::io::Result<()> {
    let seeds = Path::new(env!("CARGO_MANIFEST_DIR")).join("seeds");
    for Seed { target, name, bytes } in generated_seeds() {
        let folder = seeds.join(target);
        std::fs::create_dir_all(&folder)?;
        std::fs::write(folder.join(name), bytes)?;
        println!("{target}/{name}");
    }
    Ok(())
}
