//! Every message survives the wire, fits a frame, and is not taken for another.

mod common;

use proptest::prelude::*;
use stspp_protocol::event::TriggerEvent;
use stspp_protocol::fault::{FaultReason, FaultRecord, FaultReport, FaultSet};
use stspp_protocol::message::{
    Call, FromDevice, MESSAGE_TABLE, REPLY_BIT, Reply, Request, decode_reply, encode_error,
    encode_event, encode_reply, encode_request,
};
use stspp_protocol::reply::{ActiveTiming, Alive, DeviceState, RequestError};
use stspp_protocol::request::{Arm, GetTiming, Heartbeat, SetTiming};
use stspp_protocol::timing::{MAX_SLOTS, ProjectionTiming, Slot};
use stspp_protocol::usb;
use stspp_protocol::wire::{
    DecodeError, EncodeError, Frame, FrameDecoder, MAX_FRAME_LEN, encode_frame,
};

fn with_frame<T>(bytes: &[u8], look: impl FnOnce(&Frame<'_>) -> T) -> T {
    let mut decoder = FrameDecoder::new();
    let mut rest = bytes;
    let frame = decoder.next_frame(&mut rest).expect("a frame").expect("a good frame");
    let looked = look(&frame);
    assert!(rest.is_empty(), "one frame is all of its bytes");
    looked
}

proptest! {
    #[test]
    fn requests(seq: u16, request in common::request()) {
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = request.encode(seq, &mut out).unwrap();
        prop_assert_eq!(bytes.iter().position(|&byte| byte == 0), Some(bytes.len() - 1));
        let decoded = with_frame(bytes, |frame| (frame.seq, Request::decode(frame)));
        prop_assert_eq!(decoded, (seq, Ok(request)));
        // The host never takes a request for something that a device says.
        let as_reply = with_frame(bytes, FromDevice::decode);
        let is_unknown = matches!(as_reply, Err(DecodeError::UnknownId { .. }));
        prop_assert!(is_unknown);
    }

    #[test]
    fn replies(seq: u16, reply in common::reply()) {
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = reply.encode(seq, &mut out).unwrap();
        let decoded = with_frame(bytes, FromDevice::decode);
        prop_assert_eq!(decoded, Ok(FromDevice::Reply { seq, reply: Ok(reply) }));
        let as_request = with_frame(bytes, Request::decode);
        let is_unknown = matches!(as_request, Err(RequestError::UnknownMessage { .. }));
        prop_assert!(is_unknown);
    }

    #[test]
    fn errors(seq: u16, error in common::error()) {
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = encode_error(seq, &error, &mut out).unwrap();
        let decoded = with_frame(bytes, FromDevice::decode);
        prop_assert_eq!(decoded, Ok(FromDevice::Reply { seq, reply: Err(error) }));
        prop_assert_eq!(with_frame(bytes, decode_reply::<Arm>), Ok(Err(error)));
        prop_assert!(!error.to_string().is_empty());
    }

    #[test]
    fn events(seq: u16, event in common::event()) {
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = event.encode(seq, &mut out).unwrap();
        let decoded = with_frame(bytes, FromDevice::decode);
        prop_assert_eq!(decoded, Ok(FromDevice::Event { seq, event }));
    }

    #[test]
    fn a_body_that_is_longer_or_shorter_is_refused(request in common::request(), extra in 1usize..4) {
        let mut out = [0; MAX_FRAME_LEN];
        let (id, body) =
            with_frame(request.encode(0, &mut out).unwrap(), |frame| (frame.id, frame.body.to_vec()));
        let mut longer = body.clone();
        longer.extend(std::iter::repeat_n(0, extra));
        let decoded = Request::decode(&Frame { id, seq: 0, body: &longer });
        prop_assert_eq!(decoded, Err(RequestError::Malformed { id }));
        if !body.is_empty() {
            let decoded = Request::decode(&Frame { id, seq: 0, body: &body[..body.len() - 1] });
            prop_assert_eq!(decoded, Err(RequestError::Malformed { id }));
        }
    }

    #[test]
    fn a_short_buffer_is_an_error(request in common::request(), room in 0usize..MAX_FRAME_LEN) {
        let mut out = [0; MAX_FRAME_LEN];
        let needed = request.encode(9, &mut out).unwrap().len();
        let result = request.encode(9, &mut out[..room]).map(<[u8]>::len);
        prop_assert_eq!(result, if room >= needed { Ok(needed) } else { Err(EncodeError) });
    }
}

#[test]
fn typed_calls_get_their_own_reply() {
    let mut out = [0; MAX_FRAME_LEN];
    let alive = Alive { device_time_us: 1 << 40, state: DeviceState::Armed };
    let bytes = encode_reply::<Heartbeat>(5, &Ok(alive), &mut out).unwrap();
    with_frame(bytes, |frame| {
        assert_eq!(frame.id, Heartbeat::ID | REPLY_BIT);
        assert_eq!(decode_reply::<Heartbeat>(frame), Ok(Ok(alive)));
        assert_eq!(
            decode_reply::<GetTiming>(frame),
            Err(DecodeError::UnknownId { id: Heartbeat::ID | REPLY_BIT })
        );
    });
}

#[test]
fn ids_are_unique_and_in_their_ranges() {
    let mut ids: Vec<u8> = MESSAGE_TABLE.iter().map(|row| row.id).collect();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids.len(), MESSAGE_TABLE.len());
    for row in MESSAGE_TABLE {
        let range = if row.reply.is_empty() { 0x40..=0x7F } else { 0x01..=0x3F };
        assert!(range.contains(&row.id), "{} has id {:#04x}", row.name, row.id);
        assert!(row.purpose.ends_with('.'), "{}", row.name);
    }
}

/// The largest bodies there can be: varints at full width, all slots, all options.
#[test]
fn the_largest_messages_fit_a_frame() {
    let slot = Slot { projector_mask: u16::MAX, floodlight: true };
    let timing = ProjectionTiming {
        slots: std::iter::repeat_n(slot, MAX_SLOTS).collect(),
        frame_period_us: u32::MAX,
        exposure_us: u32::MAX,
        trigger_delay_us: u32::MAX,
        gate_lead_us: u32::MAX,
        gate_lag_us: u32::MAX,
    };
    let record = FaultRecord {
        reason: FaultReason::HardFault,
        time_us: u64::MAX,
        value: i32::MIN,
        limit: i32::MIN,
    };
    let full = FaultSet(u32::MAX);
    let report =
        FaultReport { latched: full, active: full, first: Some(record), last: Some(record) };
    let active =
        ActiveTiming { timing: timing.clone(), timing_generation: u16::MAX, pending: true };
    let mut out = [0; MAX_FRAME_LEN];
    encode_request(u16::MAX, &SetTiming { timing }, &mut out).unwrap();
    Reply::GetTiming(active).encode(u16::MAX, &mut out).unwrap();
    Reply::GetFaults(report).encode(u16::MAX, &mut out).unwrap();
    let trigger = TriggerEvent {
        frame_sequence: u32::MAX,
        slot_index: u8::MAX,
        projector_mask: u16::MAX,
        floodlight: true,
        trigger_time_us: u64::MAX,
        usb_sof: Some(u16::MAX),
        timing_generation: u16::MAX,
    };
    let event = encode_event(u16::MAX, &trigger, &mut out).unwrap();
    assert!(event.len() <= usb::MAX_PACKET_LEN, "a trigger event is one packet: {}", event.len());
}

#[test]
fn a_message_too_long_for_any_frame_is_an_error() {
    let mut out = [0; 1024];
    assert_eq!(encode_frame(1, 0, &[1u8; 256].as_slice(), &mut out), Err(EncodeError));
}
