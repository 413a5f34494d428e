//! See `drivers::hostile::client`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::hostile::client(bytes));
