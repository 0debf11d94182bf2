//! Reader of a ring that a circular DMA channel fills.
//!
//! The channel counts down CHxCNT and reloads it at the end; `capacity - CNT` is where it writes
//! next. A reader that lags by a whole lap cannot tell from the counter alone, so the driver counts
//! laps in the channel's full-transfer interrupt and tells them here.

/// Position of the reader and of the DMA, in bytes since start.
#[derive(Debug, Clone, Copy)]
pub struct RingReader {
    capacity: usize,
    read: u32,
}

/// The DMA overwrote bytes that were not read yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Overrun {
    /// Bytes lost.
    pub lost: u32,
}

impl RingReader {
    /// A reader at the start of a ring of `capacity` bytes (a power of two).
    pub const fn new(capacity: usize) -> Self {
        assert!(capacity.is_power_of_two());
        Self { capacity, read: 0 }
    }

    /// Bytes written since start, from full laps and the channel's remaining count.
    ///
    /// The lap interrupt may be pending: then CNT has already reloaded but `laps` is one short, and
    /// the caller passes `lap_pending`. It must read the flag *after* the count; a flag that rises
    /// in between is told from the count itself (a lap that has just ended has a large count).
    pub const fn written(&self, laps: u32, remaining: u32, lap_pending: bool) -> u32 {
        let in_lap = self.capacity as u32 - remaining;
        let pending = lap_pending && in_lap < self.capacity as u32 / 2;
        (laps + pending as u32).wrapping_mul(self.capacity as u32).wrapping_add(in_lap)
    }

    /// What can be read now as a contiguous range of ring indices, at most to the ring's end.
    pub fn available(&mut self, written: u32) -> Result<core::ops::Range<usize>, Overrun> {
        let filled = written.wrapping_sub(self.read);
        if filled > self.capacity as u32 {
            self.read = written;
            return Err(Overrun { lost: filled });
        }
        let start = self.read as usize & (self.capacity - 1);
        let end = (start + filled as usize).min(self.capacity);
        Ok(start..end)
    }

    /// Marks `bytes` as read.
    pub const fn consume(&mut self, bytes: usize) {
        self.read = self.read.wrapping_add(bytes as u32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_comes_out_once_in_order() {
        let mut reader = RingReader::new(16);
        let mut ring = [0u8; 16];
        let (mut total, mut taken) = (0u32, 0u32);
        for burst in [1u32, 7, 15, 16, 3, 16, 11, 2, 16, 16, 5] {
            for _ in 0..burst {
                ring[total as usize % 16] = total as u8;
                total += 1;
            }
            let written = reader.written(total / 16, 16 - total % 16, false);
            assert_eq!(written, total);
            loop {
                let range = reader.available(written).unwrap();
                if range.is_empty() {
                    break;
                }
                for &byte in &ring[range.clone()] {
                    assert_eq!(byte, taken as u8);
                    taken += 1;
                }
                reader.consume(range.len());
            }
            assert_eq!(taken, total);
        }
    }

    #[test]
    fn a_pending_lap_is_counted_once() {
        let reader = RingReader::new(16);
        assert_eq!(reader.written(3, 15, true), 65, "the interrupt is late: lap 4 began");
        assert_eq!(reader.written(3, 1, true), 63, "the flag rose after the count was read");
        assert_eq!(reader.written(4, 15, false), 65);
    }

    #[test]
    fn a_lap_too_many_is_an_overrun() {
        let mut reader = RingReader::new(16);
        assert_eq!(reader.available(17), Err(Overrun { lost: 17 }));
        assert_eq!(reader.available(17), Ok(1..1), "it goes on from there");
        assert_eq!(reader.available(20), Ok(1..4));
    }
}
