//! `cargo +nightly fuzz run decode` in `protocol/`: any bytes into the decoders of both sides.
#![no_main]

#[path = "check.rs"]
mod check;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| check::any_bytes(bytes));
