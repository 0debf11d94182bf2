//! The status LED: short flash every second at rest, even blinking when armed, on while running,
//! fast blinking on a fault.

use crate::shared;
use embassy_gd32f3x0::gpio::Output;
use embassy_time::Timer;
use stspp_protocol::reply::DeviceState;

/// Blinks for ever.
#[embassy_executor::task]
pub(crate) async fn run(mut led: Output<'static>) {
    loop {
        let state = shared::with_controller(|controller, _| controller.state());
        let (on_ms, off_ms) = match state {
            DeviceState::Idle => (50, 950),
            DeviceState::Armed => (500, 500),
            DeviceState::Running => (200, 0),
            DeviceState::Faulted => (100, 100),
        };
        led.set_high();
        Timer::after_millis(on_ms).await;
        if off_ms > 0 {
            led.set_low();
            Timer::after_millis(off_ms).await;
        }
    }
}
