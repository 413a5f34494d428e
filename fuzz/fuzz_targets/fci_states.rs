//! See `drivers::hostile::states`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::hostile::states(bytes));
