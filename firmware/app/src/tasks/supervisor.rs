//! Time-outs, what interrupts found, and the watchdog.

use crate::{engine, safety, shared};
use embassy_futures::select::select;
use embassy_gd32f3x0::watchdog::Watchdog;
use embassy_gd32f3x0::{guard, reset};
use embassy_time::{Duration, Instant, Timer};
use stspp_protocol::fault::FaultReason;

/// Longest time between two rounds.
const ROUND: Duration = Duration::from_millis(5);

/// The supervisor. It alone feeds the watchdog: when it does not come round, the chip is reset.
#[embassy_executor::task]
pub(crate) async fn run(mut watchdog: Watchdog<'static>) {
    let mut closed = safety::interlock_is_closed();
    loop {
        let opened = safety::take_interlock_opened();
        let closed_now = safety::interlock_is_closed();
        let deadline_us = shared::with_controller(|controller, now_us| {
            if opened {
                // Also an opening that is over already.
                controller.on_interlock(now_us, false);
            }
            if opened || closed != closed_now {
                controller.on_interlock(now_us, closed_now);
            }
            if guard::take_tripped() {
                let limit_us = crate::board::BOARD.limits().max_on_time_us as i32;
                controller.on_fault(now_us, FaultReason::OnTime, limit_us, limit_us);
            }
            if reset::take_debug_halt() {
                controller.on_debug_halt(now_us);
            }
            if let Some((made, planned)) = engine::tend() {
                controller.on_fault(now_us, FaultReason::EdgeDma, made as i32, planned as i32);
            }
            controller.poll(now_us);
            controller.next_deadline_us()
        });
        closed = closed_now;
        watchdog.feed();
        let round = Instant::now() + ROUND;
        let until = deadline_us.map_or(round, |us| round.min(Instant::from_micros(us)));
        select(Timer::at(until), shared::WAKE.wait()).await;
    }
}
