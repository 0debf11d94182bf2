//! Messages between the stspp sensor and its host: types, framing, and the projection timing.
//!
//! * [`message`] is the table: every request with its reply, every event, their ids.
//! * [`wire`] is the byte layout: COBS frames, CRC, an incremental decoder.
//! * [`timing`] is what is projected and when, and the one validator for it.
//! * [`version`] states the compatibility rule and what a device says about itself.
//!
//! `no_std`, no allocator: the same code runs on the microcontroller and on the host.
//! `docs/protocol.md` has the prose, the timing diagram and the state machine.
//!
//! ```
//! use stspp_protocol::message::{FromDevice, Request, Reply, encode_request};
//! use stspp_protocol::request::Heartbeat;
//! use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN};
//!
//! let mut out = [0; MAX_FRAME_LEN];
//! let bytes = encode_request(7, &Heartbeat, &mut out).unwrap();
//!
//! let mut decoder = FrameDecoder::new();
//! let mut rest = bytes;
//! let frame = decoder.next_frame(&mut rest).unwrap().unwrap();
//! assert_eq!(frame.seq, 7);
//! assert_eq!(Request::decode(&frame), Ok(Request::Heartbeat(Heartbeat)));
//! ```
#![no_std]
#![forbid(unsafe_code)]

pub mod event;
pub mod fault;
pub mod message;
pub mod reply;
pub mod request;
pub mod timing;
pub mod trigger;
pub mod units;
pub mod usb;
pub mod version;
pub mod wire;
