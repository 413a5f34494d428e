//! See `drivers::hostile::messages`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::hostile::messages(bytes));
