//! Reads the firmware's RTT buffer (SEGGER Real-Time Transfer) out of RAM, as a debug probe does.

use crate::chip::Chip;
use crate::image::Image;

/// The up-channel 0 of the firmware's RTT control block.
#[derive(Debug, Clone, Copy)]
pub struct Rtt {
    control_block: u32,
}

const ID: &[u8] = b"SEGGER RTT";
/// Offsets in the control block: identifier 16 bytes, two counts, then the up-channels.
const UP_CHANNEL: u32 = 24;
const BUFFER: u32 = 4;
const SIZE: u32 = 8;
const WRITE: u32 = 12;
const READ: u32 = 16;

impl Rtt {
    /// Finds the control block by its symbol.
    #[must_use]
    pub fn locate(image: &Image) -> Option<Self> {
        image.symbol("_SEGGER_RTT").map(|control_block| Self { control_block })
    }

    /// Takes the bytes that wait in the buffer. Empty until the firmware has set it up.
    pub fn read(&self, chip: &mut Chip) -> Vec<u8> {
        if chip.peek_bytes(self.control_block, ID.len()) != ID {
            return Vec::new();
        }
        let channel = self.control_block + UP_CHANNEL;
        let (buffer, size) = (chip.peek(channel + BUFFER), chip.peek(channel + SIZE));
        let (write, mut read) = (chip.peek(channel + WRITE), chip.peek(channel + READ));
        if size == 0 || write >= size || read >= size {
            return Vec::new();
        }
        let mut bytes = Vec::new();
        while read != write {
            bytes.extend(chip.peek_bytes(buffer + read, 1));
            read = (read + 1) % size;
        }
        chip.poke(channel + READ, read);
        bytes
    }
}
