//! See `drivers::fuzz::recording`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::fuzz::recording(bytes));
