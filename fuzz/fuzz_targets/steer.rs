//! Fuzz target for the messages of clients that steer an arm.
#![no_main]

libfuzzer_sys::fuzz_target!(|messages: &str| viz::check_steering_messages(messages));
