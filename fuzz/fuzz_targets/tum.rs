//! See `drivers::hostile::tum`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::hostile::tum(bytes));
