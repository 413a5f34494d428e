//! See `drivers::hostile::nerfstudio`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::hostile::nerfstudio(bytes));
