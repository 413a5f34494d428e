//! Fuzz target for the messages of viewers: versions, requests and subscriptions.
#![no_main]

libfuzzer_sys::fuzz_target!(|messages: &str| viz::check_messages(messages));
