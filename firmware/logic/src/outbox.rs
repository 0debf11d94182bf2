//! Events on their way to the host.
//!
//! Bounded: when the link is slower than the events, one is dropped and counted, and its sequence
//! number with it, so that the host sees the gap. A trigger that finds no room is the one that goes;
//! faults and changes of state push the oldest out instead.

use heapless::Deque;
use stspp_protocol::message::Event;

/// Events that wait at most.
pub const OUTBOX_LEN: usize = 16;

/// A bounded queue of numbered events.
#[derive(Debug)]
pub struct Outbox {
    waiting: Deque<(u16, Event), OUTBOX_LEN>,
    next_seq: u16,
    dropped: u32,
}

impl Default for Outbox {
    fn default() -> Self {
        Self::new()
    }
}

impl Outbox {
    /// An empty outbox.
    #[must_use]
    pub const fn new() -> Self {
        Self { waiting: Deque::new(), next_seq: 0, dropped: 0 }
    }

    /// Numbers an event and queues it, or drops and counts one.
    pub fn push(&mut self, event: impl Into<Event>) {
        let seq = self.next_seq;
        self.next_seq = seq.wrapping_add(1);
        let event = event.into();
        if self.waiting.is_full() {
            self.dropped = self.dropped.wrapping_add(1);
            if matches!(event, Event::TriggerEvent(_)) {
                return;
            }
            self.waiting.pop_front();
        }
        // There is room now.
        let _ = self.waiting.push_back((seq, event));
    }

    /// Takes the oldest event and its sequence number.
    pub fn pop(&mut self) -> Option<(u16, Event)> {
        self.waiting.pop_front()
    }

    /// Whether nothing waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Events dropped so far; wraps.
    #[must_use]
    pub const fn dropped(&self) -> u32 {
        self.dropped
    }
}
