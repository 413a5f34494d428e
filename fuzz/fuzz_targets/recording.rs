//! See `drivers::hostile::recording`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::hostile::recording(bytes));
