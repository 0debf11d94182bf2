//! The firmware's own log: defmt frames from its RTT buffer, decoded with the ELF's string table.

use defmt_decoder::{DecodeError, Table};

use crate::chip::Chip;
use crate::image::Image;
use crate::rtt::Rtt;

/// Decodes the log of one firmware image.
pub struct DefmtLog {
    table: Table,
    rtt: Rtt,
    bytes: Vec<u8>,
}

impl DefmtLog {
    /// The decoder for `image`; `None` where it has no defmt table or no RTT.
    #[must_use]
    pub fn new(image: &Image) -> Option<Self> {
        let table = Table::parse(&image.elf).ok().flatten()?;
        Some(Self { table, rtt: Rtt::locate(image)?, bytes: Vec::new() })
    }

    /// Takes the lines that the firmware has logged since the last call: level and text.
    pub fn read(&mut self, chip: &mut Chip) -> Vec<String> {
        self.bytes.extend(self.rtt.read(chip));
        let mut lines = Vec::new();
        let mut decoder = self.table.new_stream_decoder();
        decoder.received(&self.bytes);
        loop {
            match decoder.decode() {
                Ok(frame) => {
                    let level = frame.level().map_or("print", |level| level.as_str());
                    lines.push(format!("{level}: {}", frame.display_message()));
                }
                Err(DecodeError::UnexpectedEof) => break,
                Err(DecodeError::Malformed) => {
                    lines.push("(a damaged log frame)".to_string());
                    if !self.table.encoding().can_recover() {
                        break;
                    }
                }
            }
        }
        drop(decoder);
        self.keep_unfinished();
        lines
    }

    /// With the framed encoding, frames end in a zero byte: what follows the last one is unfinished.
    fn keep_unfinished(&mut self) {
        let end = self.bytes.iter().rposition(|byte| *byte == 0).map_or(0, |position| position + 1);
        self.bytes.drain(..end);
    }
}
