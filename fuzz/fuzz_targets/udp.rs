//! See `drivers::hostile::datagrams`.
#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drivers::hostile::datagrams(bytes));
