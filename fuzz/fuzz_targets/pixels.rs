//! See `drivers::fuzz::pixels`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::fuzz::pixels(bytes));
