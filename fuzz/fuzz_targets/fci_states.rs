//! See `drivers::fuzz::states`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::fuzz::states(bytes));
