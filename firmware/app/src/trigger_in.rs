//! Trigger-in: an edge at PA1 starts a slot.
//!
//! Its EXTI line shares the vector, and so the priority 0, of the interlock. [`on_edge`] only notes the
//! time and pends a software interrupt of priority 1, which commits the slot ([`crate::engine`]). The
//! slot starts a fixed time after the edge, so how late that runs moves nothing.
//!
//! An input gone wild must not keep the processor busy at the highest priority: after
//! [`EDGES_PER_ROUND`] edges between two rounds of the supervisor the line is masked until the next.

use crate::board::TRIGGER_LINE;
use crate::engine;
use core::sync::atomic::{AtomicU32, Ordering};
use embassy_gd32f3x0::exti::RawLine;
use embassy_gd32f3x0::interrupt::typelevel::{self, Handler};
use embassy_gd32f3x0::interrupt::{Interrupt, InterruptExt};
use embassy_gd32f3x0::time_driver;
use embassy_time::Instant;

/// Edges between two rounds of the supervisor, 5 ms apart at most: far more than slots fit in.
const EDGES_PER_ROUND: u32 = 64;

/// Low half of the time of the first edge that is not served.
static EDGE_AT: AtomicU32 = AtomicU32::new(0);
/// Edges that are not served.
static EDGES: AtomicU32 = AtomicU32::new(0);
/// Edges since the supervisor's last round.
static ROUND_EDGES: AtomicU32 = AtomicU32::new(0);

/// An edge: the interrupt of priority 0 calls it. No critical section, no waker, no log.
#[inline(always)]
pub(crate) fn on_edge() {
    let at = time_driver::counter();
    RawLine::acknowledge(TRIGGER_LINE);
    if EDGES.fetch_add(1, Ordering::Relaxed) == 0 {
        EDGE_AT.store(at, Ordering::Relaxed);
    }
    if ROUND_EDGES.fetch_add(1, Ordering::Relaxed) >= EDGES_PER_ROUND {
        RawLine::mask(TRIGGER_LINE);
    }
    Interrupt::I2C0_ER.pend();
}

/// Software interrupt: commits the slot of an edge.
pub(crate) struct EdgeHandler;

impl Handler<typelevel::I2C0_ER> for EdgeHandler {
    unsafe fn on_interrupt() {
        // While edges are waiting `on_edge` leaves the time alone.
        let at = EDGE_AT.load(Ordering::Relaxed);
        let edges = EDGES.swap(0, Ordering::Relaxed);
        if edges != 0 {
            let now_us = Instant::now().as_micros();
            let since_us = (now_us as u32).wrapping_sub(at);
            engine::on_trigger_edge(now_us.saturating_sub(u64::from(since_us)), edges - 1);
        }
    }
}

/// Listens, or stops listening. The supervisor calls it every round, a start as soon as it can.
pub(crate) fn listen(wanted: bool) {
    ROUND_EDGES.store(0, Ordering::Relaxed);
    if wanted {
        RawLine::unmask(TRIGGER_LINE);
    } else {
        RawLine::mask(TRIGGER_LINE);
    }
}
