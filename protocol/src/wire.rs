//! Frames on the byte stream.
//!
//! ```text
//! frame on the wire = COBS( id u8 | seq u16 LE | body | crc u16 LE ) 0x00
//! ```
//!
//! * `body` is the message in [postcard](https://postcard.jamesmunns.com/wire-format) encoding: varints
//!   for integers wider than a byte, one byte for an option's tag, no padding.
//! * `crc` is CRC-16/X-25 (polynomial 0x1021 reflected, initial and final 0xFFFF; check value 0x906E)
//!   over id, seq and body.
//! * COBS takes the zeros out, so `0x00` ends a frame and nothing else. A receiver that lost its place
//!   skips to the next zero. Empty frames (two zeros in a row) are ignored: a sender may put a zero in
//!   front of its first frame to flush what noise left behind.
//! * A packet (frame before COBS) has at most [`MAX_PACKET_LEN`] bytes, so COBS adds one byte.

use crc::{CRC_16_IBM_SDLC, Crc, Table};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Longest packet: id, sequence number, body and CRC.
pub const MAX_PACKET_LEN: usize = 200;

/// Longest frame on the wire: COBS's overhead byte and the closing zero added.
pub const MAX_FRAME_LEN: usize = MAX_PACKET_LEN + 2;

/// Longest body.
pub const MAX_BODY_LEN: usize = MAX_PACKET_LEN - HEADER_LEN - CRC_LEN;

const HEADER_LEN: usize = 3;
const CRC_LEN: usize = 2;

// COBS adds one byte per started run of 254: one in all.
const _: () = assert!(MAX_PACKET_LEN < 254);

const CRC: Crc<u16, Table<1>> = Crc::<u16, Table<1>>::new(&CRC_16_IBM_SDLC);

/// CRC of a packet's id, sequence number and body.
#[must_use]
pub fn packet_crc(bytes: &[u8]) -> u16 {
    CRC.checksum(bytes)
}

/// A packet whose CRC is right.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame<'a> {
    /// Which message.
    pub id: u8,
    /// Ties a reply to its request; counts events.
    pub seq: u16,
    /// The message, postcard.
    pub body: &'a [u8],
}

impl Frame<'_> {
    /// Reads the body as a `T`.
    ///
    /// # Errors
    ///
    /// [`DecodeError::Body`] where the bytes are not a `T`, and where bytes are left over: within a
    /// major version a message never grows.
    pub fn body_as<T: DeserializeOwned>(&self) -> Result<T, DecodeError> {
        match postcard::take_from_bytes(self.body) {
            Ok((message, [])) => Ok(message),
            _ => Err(DecodeError::Body { id: self.id }),
        }
    }
}

/// A frame that is not a message that this side knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum DecodeError {
    /// The id is not known here.
    UnknownId {
        /// The id.
        id: u8,
    },
    /// The body is not that of the message.
    Body {
        /// The id.
        id: u8,
    },
}

impl core::fmt::Display for DecodeError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            DecodeError::UnknownId { id } => write!(f, "message id {id:#04x} is not known"),
            DecodeError::Body { id } => write!(f, "the body of message {id:#04x} cannot be read"),
        }
    }
}

impl core::error::Error for DecodeError {}

/// The buffer is too short for the frame, or the message for any frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct EncodeError;

impl core::fmt::Display for EncodeError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "no room for the frame: give {MAX_FRAME_LEN} bytes")
    }
}

impl core::error::Error for EncodeError {}

/// Writes one frame to the front of `out`, its closing zero included, and returns it.
/// [`MAX_FRAME_LEN`] bytes are always enough.
///
/// # Errors
///
/// [`EncodeError`] where `out` is too short.
pub fn encode_frame<'a, T: Serialize>(
    id: u8,
    seq: u16,
    message: &T,
    out: &'a mut [u8],
) -> Result<&'a [u8], EncodeError> {
    let mut packet = [0u8; MAX_PACKET_LEN];
    packet[0] = id;
    packet[1..HEADER_LEN].copy_from_slice(&seq.to_le_bytes());
    let body_room = &mut packet[HEADER_LEN..MAX_PACKET_LEN - CRC_LEN];
    let body_len = postcard::to_slice(message, body_room).map_err(|_| EncodeError)?.len();
    let crc_at = HEADER_LEN + body_len;
    let crc = packet_crc(&packet[..crc_at]);
    packet[crc_at..crc_at + CRC_LEN].copy_from_slice(&crc.to_le_bytes());
    let packet = &packet[..crc_at + CRC_LEN];
    if out.len() < packet.len() + 2 {
        return Err(EncodeError);
    }
    let len = cobs::try_encode(packet, out).map_err(|_| EncodeError)?;
    out[len] = 0;
    Ok(&out[..=len])
}

/// Why a frame was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameError {
    /// Longer than any frame of the protocol.
    TooLong,
    /// Not COBS, or too short to be a packet.
    Encoding,
    /// The CRC is wrong.
    Crc,
}

/// Finds frames in a stream of bytes, in bounded memory, whatever the bytes are.
///
/// After an error it is in step again with the next zero.
#[derive(Debug, Clone)]
pub struct FrameDecoder {
    buffer: [u8; MAX_FRAME_LEN],
    len: usize,
    overflow: bool,
    rejected: u32,
    received: u32,
}

impl Default for FrameDecoder {
    fn default() -> Self {
        Self::new()
    }
}

impl FrameDecoder {
    /// An empty decoder.
    #[must_use]
    pub const fn new() -> Self {
        Self { buffer: [0; MAX_FRAME_LEN], len: 0, overflow: false, rejected: 0, received: 0 }
    }

    /// Forgets a half-received frame (after a link went down).
    pub const fn reset(&mut self) {
        self.len = 0;
        self.overflow = false;
    }

    /// Good frames so far; wraps.
    #[must_use]
    pub const fn received(&self) -> u32 {
        self.received
    }

    /// Dropped frames so far; wraps.
    #[must_use]
    pub const fn rejected(&self) -> u32 {
        self.rejected
    }

    /// Takes one byte; a frame comes out with its closing zero.
    ///
    /// # Errors
    ///
    /// [`FrameError`] with the zero that closes a frame which had to be dropped; decoding goes on.
    pub fn push(&mut self, byte: u8) -> Result<Option<Frame<'_>>, FrameError> {
        if byte != 0 {
            match self.buffer.get_mut(self.len) {
                Some(place) => {
                    *place = byte;
                    self.len += 1;
                }
                None => self.overflow = true,
            }
            return Ok(None);
        }
        let len = core::mem::take(&mut self.len);
        let overflow = core::mem::take(&mut self.overflow);
        if len == 0 {
            return Ok(None);
        }
        let opened =
            if overflow { Err(FrameError::TooLong) } else { open(&mut self.buffer[..len]) };
        let count = if opened.is_ok() { &mut self.received } else { &mut self.rejected };
        *count = count.wrapping_add(1);
        opened.map(Some)
    }

    /// Takes bytes from the front of `bytes` up to and including the end of the next frame, good or
    /// bad; `None` when all are taken.
    pub fn next_frame<'d>(
        &'d mut self,
        bytes: &mut &[u8],
    ) -> Option<Result<Frame<'d>, FrameError>> {
        let zero = loop {
            let (&byte, rest) = bytes.split_first()?;
            *bytes = rest;
            if byte == 0 && self.len != 0 {
                break byte;
            }
            // Only a zero after bytes can complete a frame.
            let _ = self.push(byte);
        };
        self.push(zero).transpose()
    }
}

/// Undoes COBS in place and checks length and CRC.
fn open(encoded: &mut [u8]) -> Result<Frame<'_>, FrameError> {
    let len = cobs::decode_in_place(encoded).map_err(|_| FrameError::Encoding)?;
    let packet = encoded.get(..len).ok_or(FrameError::Encoding)?;
    if packet.len() < HEADER_LEN + CRC_LEN {
        return Err(FrameError::Encoding);
    }
    let (content, crc) = packet.split_last_chunk::<CRC_LEN>().ok_or(FrameError::Encoding)?;
    if packet_crc(content) != u16::from_le_bytes(*crc) {
        return Err(FrameError::Crc);
    }
    let (header, body) = content.split_first_chunk::<HEADER_LEN>().ok_or(FrameError::Encoding)?;
    let [id, seq_low, seq_high] = *header;
    Ok(Frame { id, seq: u16::from_le_bytes([seq_low, seq_high]), body })
}
