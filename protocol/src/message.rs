//! The message table: every message of the protocol, its id, and which reply answers which request.
//!
//! A request's reply carries the request's id with [`REPLY_BIT`] set; a refusal carries [`ERROR_ID`].
//! Ids of requests are `0x01..=0x3F`, of events `0x40..=0x7F`. An id is never used again for another
//! message.

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::event::{BootEvent, FaultEvent, StateEvent, TimingEvent, TriggerEvent};
use crate::fault::FaultReport;
use crate::reply::{
    ActiveTiming, Alive, Done, RequestError, Started, Status, Stopping, TimingAccepted,
};
use crate::request::{
    Arm, ClearFaults, Disarm, FloodlightOff, FloodlightOn, GetFaults, GetInfo, GetStatus,
    GetTiming, GetTriggerSource, Heartbeat, Hello, LoadDefaults, LoadSettings, RebootToBootloader,
    Reset, SaveSettings, SetTiming, SetTriggerSource, StartBurst, StartStream, StopStream,
};
use crate::trigger::TriggerInput;
use crate::version::DeviceInfo;
use crate::wire::{DecodeError, EncodeError, Frame, encode_frame};

/// Set in the id of a reply.
pub const REPLY_BIT: u8 = 0x80;

/// Id of a reply that is a [`RequestError`].
pub const ERROR_ID: u8 = 0xFF;

/// A request type: its id, and the type that answers it.
pub trait Call: Serialize + DeserializeOwned {
    /// Id of the request.
    const ID: u8;
    /// What the device answers.
    type Reply: Serialize + DeserializeOwned;
}

/// An event type.
pub trait Push: Serialize + DeserializeOwned {
    /// Id of the event.
    const ID: u8;
}

/// A row of the message table, for documentation and tools.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageRow {
    /// Id.
    pub id: u8,
    /// Type of the request or event.
    pub name: &'static str,
    /// Type of the reply; empty for an event.
    pub reply: &'static str,
    /// What it is for.
    pub purpose: &'static str,
}

macro_rules! messages {
    (
        requests { $($id:literal $method:ident: $request:ident => $reply:ident, $purpose:literal;)* }
        events { $($event_id:literal $event:ident, $event_purpose:literal;)* }
    ) => {
        $(impl Call for $request {
            const ID: u8 = $id;
            type Reply = $reply;
        })*

        $(impl Push for $event {
            const ID: u8 = $event_id;
        })*

        /// Every request, then every event, in order of id.
        pub const MESSAGE_TABLE: &[MessageRow] = &[
            $(MessageRow {
                id: $id,
                name: stringify!($request),
                reply: stringify!($reply),
                purpose: $purpose,
            },)*
            $(MessageRow {
                id: $event_id,
                name: stringify!($event),
                reply: "",
                purpose: $event_purpose,
            },)*
        ];

        /// Any request.
        #[derive(Debug, Clone, PartialEq, Eq)]
        #[allow(clippy::large_enum_variant, reason = "no allocator to box with; one is alive at a time")]
        pub enum Request {
            $(#[doc = $purpose] $request($request),)*
        }

        impl Request {
            /// Reads the request that a frame carries.
            ///
            /// # Errors
            ///
            /// [`RequestError::UnknownMessage`] or [`RequestError::Malformed`]: what the device answers.
            pub fn decode(frame: &Frame<'_>) -> Result<Self, RequestError> {
                let malformed = |_| RequestError::Malformed { id: frame.id };
                match frame.id {
                    $($id => frame.body_as().map(Request::$request).map_err(malformed),)*
                    id => Err(RequestError::UnknownMessage { id }),
                }
            }

            /// Writes the request as a frame; returns its bytes.
            ///
            /// # Errors
            ///
            /// [`EncodeError`] where `out` is too short.
            pub fn encode<'a>(&self, seq: u16, out: &'a mut [u8]) -> Result<&'a [u8], EncodeError> {
                match self {
                    $(Request::$request(request) => encode_frame($id, seq, request, out),)*
                }
            }
        }

        /// Any reply but a refusal; named after the request that it answers.
        #[derive(Debug, Clone, PartialEq, Eq)]
        #[allow(clippy::large_enum_variant, reason = "no allocator to box with; one is alive at a time")]
        pub enum Reply {
            $(#[doc = concat!("Answer to [`", stringify!($request), "`].")] $request($reply),)*
        }

        impl Reply {
            /// Writes the reply as a frame; returns its bytes.
            ///
            /// # Errors
            ///
            /// [`EncodeError`] where `out` is too short.
            pub fn encode<'a>(&self, seq: u16, out: &'a mut [u8]) -> Result<&'a [u8], EncodeError> {
                match self {
                    $(Reply::$request(reply) => encode_frame($id | REPLY_BIT, seq, reply, out),)*
                }
            }
        }

        /// Any event.
        #[derive(Debug, Clone, PartialEq, Eq)]
        pub enum Event {
            $(#[doc = $event_purpose] $event($event),)*
        }

        impl Event {
            /// Writes the event as a frame; returns its bytes.
            ///
            /// # Errors
            ///
            /// [`EncodeError`] where `out` is too short.
            pub fn encode<'a>(&self, seq: u16, out: &'a mut [u8]) -> Result<&'a [u8], EncodeError> {
                match self {
                    $(Event::$event(event) => encode_frame($event_id, seq, event, out),)*
                }
            }
        }

        $(impl From<$event> for Event {
            fn from(event: $event) -> Self {
                Event::$event(event)
            }
        })*

        /// What answers requests: one method per request, whose types pair as the table does.
        pub trait Serve {
            $(
                #[doc = $purpose]
                ///
                /// # Errors
                ///
                /// Why the request is refused; then nothing has changed.
                fn $method(&mut self, request: $request) -> Result<$reply, RequestError>;
            )*

            /// Hands a request to its method.
            ///
            /// # Errors
            ///
            /// Those of the method.
            fn serve(&mut self, request: Request) -> Result<Reply, RequestError> {
                match request {
                    $(Request::$request(request) => self.$method(request).map(Reply::$request),)*
                }
            }
        }

        impl FromDevice {
            /// Reads what a frame from the device carries.
            ///
            /// # Errors
            ///
            /// [`DecodeError`]: a host skips frames of unknown id (a newer device) and counts the rest.
            pub fn decode(frame: &Frame<'_>) -> Result<Self, DecodeError> {
                const REPLY_IDS: &[(u8, u8)] = &[$(($id, $id | REPLY_BIT),)*];
                debug_assert!(REPLY_IDS.iter().all(|&(id, reply)| id < 0x40 && reply != ERROR_ID));
                if frame.id == ERROR_ID {
                    return Ok(FromDevice::Reply { seq: frame.seq, reply: Err(frame.body_as()?) });
                }
                if frame.id & REPLY_BIT != 0 {
                    let reply = match frame.id & !REPLY_BIT {
                        $($id => Reply::$request(frame.body_as()?),)*
                        _ => return Err(DecodeError::UnknownId { id: frame.id }),
                    };
                    return Ok(FromDevice::Reply { seq: frame.seq, reply: Ok(reply) });
                }
                let event = match frame.id {
                    $($event_id => Event::$event(frame.body_as()?),)*
                    id => return Err(DecodeError::UnknownId { id }),
                };
                Ok(FromDevice::Event { seq: frame.seq, event })
            }
        }
    };
}

messages! {
    requests {
        // id  method             request type         reply type
        0x01 hello:              Hello              => DeviceInfo,
            "Start a session: check versions, stop, disarm.";
        0x02 get_info:           GetInfo            => DeviceInfo,
            "Who the device is, without touching the session.";
        0x03 heartbeat:          Heartbeat          => Alive,
            "The host is alive; answers device time and state.";
        0x04 get_status:         GetStatus          => Status,
            "State, counters, interlock, temperature.";
        0x05 get_timing:         GetTiming          => ActiveTiming,
            "The timing accepted last and its generation.";
        0x06 set_timing:         SetTiming          => TimingAccepted,
            "Replace the timing, from the next slot cycle on.";
        0x07 arm:                Arm                => Done,
            "Allow light.";
        0x08 disarm:             Disarm             => Done,
            "Switch all light off at once and forbid it.";
        0x09 start_stream:       StartStream        => Started,
            "Cycle through the slots until stopped.";
        0x0A stop_stream:        StopStream         => Stopping,
            "End a stream or burst after the current slot.";
        0x0B start_burst:        StartBurst         => Started,
            "Trigger a number of frames, then stop.";
        0x0C floodlight_on:      FloodlightOn       => Done,
            "Floodlight on for a bounded time while armed.";
        0x0D floodlight_off:     FloodlightOff      => Done,
            "Floodlight off.";
        0x0E get_faults:         GetFaults          => FaultReport,
            "Latched faults, those still active, first and last.";
        0x0F clear_faults:       ClearFaults        => FaultReport,
            "Unlatch faults whose cause is gone.";
        0x10 save_settings:      SaveSettings       => Done,
            "Store the timing for the next power-on.";
        0x11 load_settings:      LoadSettings       => ActiveTiming,
            "Go back to the stored settings.";
        0x12 load_defaults:      LoadDefaults       => ActiveTiming,
            "Go back to a new device's settings, without storing.";
        0x13 reset:              Reset              => Done,
            "Restart the controller after the reply.";
        0x14 reboot_to_bootloader: RebootToBootloader => Done,
            "Restart into the bootloader after the reply.";
        0x15 set_trigger_source: SetTriggerSource   => Done,
            "Choose what starts slots: the gate timer, or edges at trigger-in (since 1.1).";
        0x16 get_trigger_source: GetTriggerSource   => TriggerInput,
            "What starts slots, and the edges seen (since 1.1).";
    }
    events {
        0x40 TriggerEvent, "One camera trigger: labels the frame of each camera.";
        0x41 FaultEvent,   "A fault latched; the light is off.";
        0x42 StateEvent,   "The device changed state.";
        0x43 TimingEvent,  "A new timing took effect.";
        0x44 BootEvent,    "The controller started.";
    }
}

/// Anything that a device sends.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(clippy::large_enum_variant, reason = "no allocator to box with; one is alive at a time")]
pub enum FromDevice {
    /// The answer to the request of the same sequence number.
    Reply {
        /// The request's sequence number.
        seq: u16,
        /// The answer, or why there is none.
        reply: Result<Reply, RequestError>,
    },
    /// An event.
    Event {
        /// Counts events.
        seq: u16,
        /// The event.
        event: Event,
    },
}

/// Writes a request as a frame; returns its bytes.
///
/// # Errors
///
/// [`EncodeError`] where `out` is too short.
pub fn encode_request<'a, C: Call>(
    seq: u16,
    request: &C,
    out: &'a mut [u8],
) -> Result<&'a [u8], EncodeError> {
    encode_frame(C::ID, seq, request, out)
}

/// Writes the answer to a request of type `C`, or its refusal, as a frame; returns its bytes.
///
/// # Errors
///
/// [`EncodeError`] where `out` is too short.
pub fn encode_reply<'a, C: Call>(
    seq: u16,
    reply: &Result<C::Reply, RequestError>,
    out: &'a mut [u8],
) -> Result<&'a [u8], EncodeError> {
    match reply {
        Ok(reply) => encode_frame(C::ID | REPLY_BIT, seq, reply, out),
        Err(error) => encode_error(seq, error, out),
    }
}

/// Writes a refusal as a frame; returns its bytes.
///
/// # Errors
///
/// [`EncodeError`] where `out` is too short.
pub fn encode_error<'a>(
    seq: u16,
    error: &RequestError,
    out: &'a mut [u8],
) -> Result<&'a [u8], EncodeError> {
    encode_frame(ERROR_ID, seq, error, out)
}

/// Writes an event as a frame; returns its bytes.
///
/// # Errors
///
/// [`EncodeError`] where `out` is too short.
pub fn encode_event<'a, P: Push>(
    seq: u16,
    event: &P,
    out: &'a mut [u8],
) -> Result<&'a [u8], EncodeError> {
    encode_frame(P::ID, seq, event, out)
}

/// Reads the answer to a request of type `C` from a frame.
///
/// # Errors
///
/// [`DecodeError`] where the frame is not an answer to such a request.
pub fn decode_reply<C: Call>(
    frame: &Frame<'_>,
) -> Result<Result<C::Reply, RequestError>, DecodeError> {
    match frame.id {
        ERROR_ID => frame.body_as().map(Err),
        id if id == C::ID | REPLY_BIT => frame.body_as().map(Ok),
        id => Err(DecodeError::UnknownId { id }),
    }
}
