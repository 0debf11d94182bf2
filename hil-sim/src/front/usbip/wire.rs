//! Byte layout of USB/IP 1.1.1: all fields big-endian, commands and replies 48 bytes and then data.

use super::client::Transfer;
use crate::front::usb::{Identity, Speed};
use std::io::{self, Read};

/// Protocol version in the operation headers.
pub const VERSION: u16 = 0x0111;
/// The host asks which devices there are.
pub const OP_REQ_DEVLIST: u16 = 0x8005;
/// The answer to it.
pub const OP_REP_DEVLIST: u16 = 0x0005;
/// The host asks for a device.
pub const OP_REQ_IMPORT: u16 = 0x8003;
/// The answer to it.
pub const OP_REP_IMPORT: u16 = 0x0003;

const CMD_SUBMIT: u32 = 1;
const CMD_UNLINK: u32 = 2;
const RET_SUBMIT: u32 = 3;
const RET_UNLINK: u32 = 4;

/// Largest transfer that a host may ask for: more is a broken stream, not a request.
pub const TRANSFER_MAX: usize = 16 << 20;

/// A command of the host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Command {
    /// A transfer.
    Submit(Submit),
    /// Gives up the transfer with that sequence number.
    Unlink {
        /// Sequence number of this command.
        sequence: u32,
        /// Sequence number of the transfer.
        victim: u32,
    },
}

/// A transfer asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Submit {
    /// Ties the reply to it.
    pub sequence: u32,
    /// Whether data goes to the host.
    pub is_in: bool,
    /// Endpoint number without direction.
    pub endpoint: u8,
    /// Length of the host's buffer.
    pub length: usize,
    /// Setup packet of a control transfer.
    pub setup: [u8; 8],
    /// Data to the device.
    pub data: Vec<u8>,
    /// Whether it is isochronous.
    pub isochronous: bool,
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_be_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// Reads the next command.
///
/// # Errors
/// The stream's, and `InvalidData` for what is no command.
pub fn read_command(stream: &mut impl Read) -> io::Result<Command> {
    let mut head = [0; 48];
    stream.read_exact(&mut head)?;
    let sequence = word(&head, 4);
    match word(&head, 0) {
        CMD_SUBMIT => {
            let is_in = word(&head, 12) != 0;
            let length = word(&head, 24) as usize;
            let packets = word(&head, 32) as i32;
            if length > TRANSFER_MAX || packets > 1024 || word(&head, 16) > 15 {
                return Err(invalid("a transfer beyond all bounds"));
            }
            let mut data = vec![0; if is_in { 0 } else { length }];
            stream.read_exact(&mut data)?;
            if packets > 0 {
                stream.read_exact(&mut vec![0; 16 * packets as usize])?;
            }
            let mut setup = [0; 8];
            setup.copy_from_slice(&head[40..48]);
            let endpoint = word(&head, 16) as u8;
            let isochronous = packets > 0;
            Ok(Command::Submit(Submit {
                sequence,
                is_in,
                endpoint,
                length,
                setup,
                data,
                isochronous,
            }))
        }
        CMD_UNLINK => Ok(Command::Unlink { sequence, victim: word(&head, 20) }),
        _ => Err(invalid("an unknown USB/IP command")),
    }
}

/// The reply to a transfer: `status` is 0 or a negative errno; `length` counts what was moved, and
/// `data` holds it when it goes to the host.
pub fn submit_reply(sequence: u32, status: i32, length: usize, data: &[u8]) -> Vec<u8> {
    let mut reply = Vec::with_capacity(48 + data.len());
    for field in [RET_SUBMIT, sequence, 0, 0, 0, status as u32, length as u32, 0, 0, 0, 0, 0] {
        reply.extend(field.to_be_bytes());
    }
    reply.extend(data);
    reply
}

/// The reply to an unlink: `status` is -ECONNRESET when the transfer was given up, 0 when it had been
/// answered already.
pub fn unlink_reply(sequence: u32, status: i32) -> Vec<u8> {
    let mut reply = Vec::with_capacity(48);
    for field in [RET_UNLINK, sequence, 0, 0, 0, status as u32, 0, 0, 0, 0, 0, 0] {
        reply.extend(field.to_be_bytes());
    }
    reply
}

/// The head of a reply, as the host reads it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReplyHead {
    /// Whether it answers an unlink.
    pub is_unlink: bool,
    /// Sequence number of the command.
    pub sequence: u32,
    /// 0 or a negative errno.
    pub status: i32,
    /// Bytes that were moved; those of an IN transfer follow.
    pub length: usize,
}

/// Reads the head of the next reply.
///
/// # Errors
/// The stream's, and `InvalidData` for what is no reply.
pub fn read_reply(stream: &mut impl Read) -> io::Result<ReplyHead> {
    let mut head = [0; 48];
    stream.read_exact(&mut head)?;
    let is_unlink = match word(&head, 0) {
        RET_SUBMIT => false,
        RET_UNLINK => true,
        _ => return Err(invalid("an unknown reply")),
    };
    let length = if is_unlink { 0 } else { word(&head, 24) as usize };
    if length > TRANSFER_MAX {
        return Err(invalid("a transfer beyond all bounds"));
    }
    Ok(ReplyHead { is_unlink, sequence: word(&head, 4), status: word(&head, 20) as i32, length })
}

/// The command that asks for a transfer; data to the device follows it.
pub fn submit_command(sequence: u32, transfer: &Transfer<'_>) -> Vec<u8> {
    let mut command = Vec::with_capacity(48 + transfer.data.len());
    let (is_in, endpoint) = (u32::from(transfer.is_in), u32::from(transfer.endpoint));
    for field in
        [CMD_SUBMIT, sequence, 0x1_0001, is_in, endpoint, 0, transfer.length as u32, 0, 0, 0]
    {
        command.extend(field.to_be_bytes());
    }
    command.extend(transfer.setup);
    command
}

/// The command that gives a transfer up.
pub fn unlink_command(sequence: u32, victim: u32) -> Vec<u8> {
    let mut command = Vec::with_capacity(48);
    for field in [CMD_UNLINK, sequence, 0, 0, 0, victim, 0, 0, 0, 0, 0, 0] {
        command.extend(field.to_be_bytes());
    }
    command
}

/// Header of an operation's request or reply.
pub fn operation_header(code: u16, ok: bool) -> Vec<u8> {
    let mut header = Vec::with_capacity(8);
    header.extend(VERSION.to_be_bytes());
    header.extend(code.to_be_bytes());
    header.extend(u32::from(!ok).to_be_bytes());
    header
}

/// The 312 bytes that describe a device; `number` makes its bus id `1-number`.
pub fn device_record(number: u32, identity: &Identity) -> Vec<u8> {
    let mut record = vec![0; 256 + 32];
    let bus_id = bus_id(number);
    let path = format!("/sys/devices/simulated/usb1/{bus_id}");
    record[..path.len()].copy_from_slice(path.as_bytes());
    record[256..256 + bus_id.len()].copy_from_slice(bus_id.as_bytes());
    // enum usb_device_speed of the kernel.
    let speed = match identity.speed {
        Speed::Full => 2u32,
        Speed::High => 3,
    };
    for field in [1, number, speed] {
        record.extend(field.to_be_bytes());
    }
    let descriptor = &identity.device_descriptor;
    for at in [8, 10, 12] {
        record.extend([descriptor[at + 1], descriptor[at]]);
    }
    record.extend(&descriptor[4..7]);
    // The configuration in use and how many there are.
    record.extend([1, descriptor[17], identity.interfaces.len() as u8]);
    record
}

/// The interface records that follow a device in a listing.
pub fn interface_records(identity: &Identity) -> Vec<u8> {
    identity
        .interfaces
        .iter()
        .flat_map(|[class, sub, protocol]| [*class, *sub, *protocol, 0])
        .collect()
}

/// Bus id of device `number`.
pub fn bus_id(number: u32) -> String {
    format!("1-{number}")
}

pub(super) fn invalid(what: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("USB/IP: {what}"))
}
