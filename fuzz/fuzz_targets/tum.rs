//! See `drivers::fuzz::tum`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::fuzz::tum(bytes));
