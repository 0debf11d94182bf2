//! What must hold for any bytes; run by the fuzzer and, with seeded bytes, by the tests.

use stspp_protocol::message::{FromDevice, Request, encode_error};
use stspp_protocol::timing::Limits;
use stspp_protocol::wire::{Frame, FrameDecoder, MAX_FRAME_LEN};

/// Decodes as both sides do. Nothing panics; what decodes encodes to a frame that decodes to the same;
/// the way the bytes are cut into pieces makes no difference; after two zeros a good frame gets through.
pub fn any_bytes(bytes: &[u8]) {
    let whole = frames(bytes.chunks(usize::MAX));
    let width = bytes.first().map_or(1, |&byte| usize::from(byte % 7) + 1);
    assert_eq!(whole, frames(bytes.chunks(width)), "cut into pieces of {width}");
    for (id, seq, body) in &whole {
        any_frame(&Frame { id: *id, seq: *seq, body });
    }
    // The bytes as a body, so that postcard sees them although no CRC fits.
    if let Some((&id, body)) = bytes.split_first() {
        any_frame(&Frame { id, seq: 0, body });
    }
    resynchronises(bytes);
}

type Owned = (u8, u16, Vec<u8>);

fn frames<'a>(pieces: impl Iterator<Item = &'a [u8]>) -> Vec<Owned> {
    let mut decoder = FrameDecoder::new();
    let mut frames = Vec::new();
    for mut piece in pieces {
        while let Some(result) = decoder.next_frame(&mut piece) {
            if let Ok(frame) = result {
                frames.push((frame.id, frame.seq, frame.body.to_vec()));
            }
        }
    }
    frames
}

fn any_frame(frame: &Frame<'_>) {
    let mut out = [0; MAX_FRAME_LEN];
    if let Ok(request) = Request::decode(frame) {
        let again = frames([request.encode(frame.seq, &mut out).expect("fits")].into_iter());
        let (id, seq, body) = &again[0];
        assert_eq!(Request::decode(&Frame { id: *id, seq: *seq, body }), Ok(request.clone()));
        // Whatever the numbers, the validators come to an answer.
        match request {
            Request::SetTiming(set) => drop(set.timing.validate(&Limits::F350)),
            Request::SetTriggerSource(set) => drop(set.source.validate()),
            _ => {}
        }
    }
    if let Ok(message) = FromDevice::decode(frame) {
        let encoded = match &message {
            FromDevice::Reply { seq, reply: Ok(reply) } => reply.encode(*seq, &mut out),
            FromDevice::Reply { seq, reply: Err(error) } => encode_error(*seq, error, &mut out),
            FromDevice::Event { seq, event } => event.encode(*seq, &mut out),
        };
        let again = frames([encoded.expect("fits")].into_iter());
        let (id, seq, body) = &again[0];
        assert_eq!(FromDevice::decode(&Frame { id: *id, seq: *seq, body }), Ok(message));
    }
}

fn resynchronises(noise: &[u8]) {
    let mut out = [0; MAX_FRAME_LEN];
    let good = Request::Arm(stspp_protocol::request::Arm).encode(77, &mut out).expect("fits");
    let mut stream = noise.to_vec();
    stream.push(0);
    stream.extend_from_slice(good);
    let heard = frames([stream.as_slice()].into_iter());
    let (_, seq, _) = heard.last().expect("the good frame gets through");
    assert_eq!(*seq, 77);
}
