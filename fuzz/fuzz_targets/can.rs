//! See `drivers::hostile::frames`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::hostile::frames(bytes));
