//! See `drivers::hostile::pixels`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::hostile::pixels(bytes));
