//! What the stspp sensor's firmware does, without the hardware it does it with.
//!
//! The same code runs on the microcontroller, under `firmware/app`, and on the host, in the simulator
//! and in tests, in virtual time.
//!
//! ```text
//!  bytes in ──► controller::receive ──► dispatch (a method per request) ──► reply bytes
//!                                          │          │          │
//!                                     sequencer    interlock   settings
//!                                          │          │          │
//!                                     GateEngine  force_off  SettingsStore     (traits: hardware)
//!                                          │
//!  slot-done interrupt ──► controller::on_slot_done ──► outbox ──► event bytes
//! ```
//!
//! * [`hardware`]: the two traits that a board implements, and what it reports.
//! * [`timing`]: a validated timing compiled to timer ticks and gate words.
//! * [`runner`]: a plan run on hardware that takes timed writes ahead.
//! * [`sequencer`]: runs, frame numbers, generations, supervision of the engine.
//! * [`interlock`]: faults that latch, and their conditions.
//! * [`duty`]: how long each emitter may still be on.
//! * [`settings`]: records in two flash pages; a torn write leaves the old one.
//! * [`outbox`]: events on their way to the host.
//! * [`controller`]: the state machine, its inputs and outputs; [`dispatch`] answers requests.
//!
//! Nothing here waits, allocates or panics; the lints below hold the last.
#![no_std]
#![forbid(unsafe_code)]
#![cfg_attr(
    not(test),
    deny(
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::indexing_slicing,
        clippy::unreachable,
        clippy::arithmetic_side_effects
    )
)]

pub mod controller;
pub mod dispatch;
pub mod duty;
pub mod hardware;
pub mod interlock;
pub mod outbox;
pub mod runner;
pub mod sequencer;
pub mod settings;
pub mod timing;
