//! See `drivers::fuzz::client`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::fuzz::client(bytes));
