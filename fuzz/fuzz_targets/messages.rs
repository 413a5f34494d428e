//! See `drivers::fuzz::messages`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::fuzz::messages(bytes));
