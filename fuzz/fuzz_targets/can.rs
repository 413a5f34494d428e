//! See `drivers::fuzz::frames`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::fuzz::frames(bytes));
