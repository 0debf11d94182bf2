//! One IN endpoint as a stream of whole frames.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use stspp_protocol::wire::MAX_FRAME_LEN;

use super::pipes::{PipeError, Pipes};
use crate::transport::TransportError;

/// Consecutive halts, or failed transfers, after which the endpoint is given up.
pub const HALTS_MAX: u32 = 5;

/// Bytes of a transfer: whole packets, so that no device can send more than fits.
const TRANSFER: usize = 512;

/// Reads an endpoint. The two IN endpoints share one decoder, so only whole frames leave here: bytes
/// of one never get between those of another.
pub struct Reader {
    name: String,
    endpoint: u8,
    pipes: Arc<dyn Pipes>,
    partial: Vec<u8>,
    failures: u32,
    halts: Arc<AtomicU64>,
}

impl Reader {
    /// A reader of `endpoint`; halts that it clears are added to `halts`.
    pub fn new(name: &str, endpoint: u8, pipes: Arc<dyn Pipes>, halts: Arc<AtomicU64>) -> Self {
        Self { name: name.to_owned(), endpoint, pipes, partial: Vec::new(), failures: 0, halts }
    }

    /// Waits up to `timeout` for a transfer; gives the frames that are whole with it, none when nothing
    /// came or the endpoint had to be cleared.
    ///
    /// # Errors
    /// When the device is gone or does not recover.
    pub fn once(&mut self, timeout: Duration) -> Result<Vec<u8>, TransportError> {
        let mut buffer = [0; TRANSFER];
        let link = || self.name.clone();
        match self.pipes.read(self.endpoint, &mut buffer, timeout) {
            Ok(length) => {
                self.failures = 0;
                Ok(self.whole(&buffer[..length.min(TRANSFER)]))
            }
            Err(PipeError::Timeout) => Ok(Vec::new()),
            Err(PipeError::Halted) if self.failures < HALTS_MAX => {
                self.failures += 1;
                self.halts.fetch_add(1, Ordering::Relaxed);
                // What was on its way is lost with the transfer: the frame is not whole any more.
                self.partial.clear();
                match self.pipes.clear_halt(self.endpoint) {
                    Err(PipeError::Gone) => Err(TransportError::Gone { link: link() }),
                    _ => Ok(Vec::new()),
                }
            }
            Err(PipeError::Halted) => Err(TransportError::Halted {
                link: link(),
                endpoint: self.endpoint,
                attempts: self.failures,
            }),
            Err(PipeError::Gone) => Err(TransportError::Gone { link: link() }),
            Err(PipeError::Io(source)) => {
                self.failures += 1;
                self.partial.clear();
                if self.failures > HALTS_MAX {
                    return Err(TransportError::Io { link: link(), source });
                }
                // A disturbance on the cable; a device that is gone says so at the next attempt.
                std::thread::sleep(Duration::from_millis(2).min(timeout));
                Ok(Vec::new())
            }
        }
    }

    fn whole(&mut self, bytes: &[u8]) -> Vec<u8> {
        self.partial.extend_from_slice(bytes);
        match self.partial.iter().rposition(|byte| *byte == 0) {
            Some(end) => self.partial.drain(..=end).collect(),
            None => {
                // No frame is this long: whatever it is goes to the decoder, which counts it.
                if self.partial.len() > MAX_FRAME_LEN {
                    std::mem::take(&mut self.partial)
                } else {
                    Vec::new()
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::VecDeque;
    use std::sync::Mutex;

    /// Reads that come out in order, then timeouts; counts cleared halts.
    #[derive(Default)]
    struct Script {
        reads: Mutex<VecDeque<Result<Vec<u8>, PipeError>>>,
        cleared: AtomicU64,
    }

    impl Pipes for Script {
        fn read(&self, _: u8, buffer: &mut [u8], _: Duration) -> Result<usize, PipeError> {
            let next = self.reads.lock().unwrap().pop_front().unwrap_or(Err(PipeError::Timeout))?;
            buffer[..next.len()].copy_from_slice(&next);
            Ok(next.len())
        }

        fn write(&self, _: u8, bytes: &[u8], _: Duration) -> Result<usize, PipeError> {
            Ok(bytes.len())
        }

        fn clear_halt(&self, _: u8) -> Result<(), PipeError> {
            self.cleared.fetch_add(1, Ordering::Relaxed);
            Ok(())
        }
    }

    fn reader(reads: Vec<Result<Vec<u8>, PipeError>>) -> (Reader, Arc<Script>) {
        let script = Arc::new(Script { reads: Mutex::new(reads.into()), ..Default::default() });
        (Reader::new("usb:", 0x81, Arc::clone(&script) as _, Arc::default()), script)
    }

    #[test]
    fn frames_over_several_packets_leave_whole() {
        let (mut reader, _) =
            reader(vec![Ok(vec![1, 2]), Ok(vec![3, 0, 4, 0, 5]), Ok(vec![]), Ok(vec![6, 0])]);
        let read: Vec<Vec<u8>> = (0..4).map(|_| reader.once(Duration::ZERO).unwrap()).collect();
        assert_eq!(read, [vec![], vec![1, 2, 3, 0, 4, 0], vec![], vec![5, 6, 0]]);
    }

    #[test]
    fn a_halt_is_cleared_and_the_broken_frame_forgotten() {
        let (mut reader, script) =
            reader(vec![Ok(vec![1]), Err(PipeError::Halted), Ok(vec![7, 0])]);
        assert!(reader.once(Duration::ZERO).unwrap().is_empty());
        assert!(reader.once(Duration::ZERO).unwrap().is_empty());
        assert_eq!(reader.once(Duration::ZERO).unwrap(), [7, 0]);
        assert_eq!(script.cleared.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn an_endpoint_that_stays_halted_is_given_up() {
        let halts = (0..=HALTS_MAX).map(|_| Err(PipeError::Halted)).collect();
        let (mut reader, _) = reader(halts);
        for _ in 0..HALTS_MAX {
            assert!(reader.once(Duration::ZERO).unwrap().is_empty());
        }
        let error = reader.once(Duration::ZERO).unwrap_err();
        assert!(matches!(error, TransportError::Halted { attempts: HALTS_MAX, .. }), "{error}");
    }

    #[test]
    fn noise_without_end_does_not_pile_up() {
        let noise = (0..10).map(|_| Ok(vec![9; 100])).collect();
        let (mut reader, _) = reader(noise);
        let bytes: usize = (0..10).map(|_| reader.once(Duration::ZERO).unwrap().len()).sum();
        assert!(bytes >= 700, "{bytes}");
    }
}
