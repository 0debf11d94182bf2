//! The controller, as the tasks share it, and the signals between them.

use crate::engine::{self, Engine};
use crate::safety;
use crate::store::Store;
use core::cell::RefCell;
use embassy_gd32f3x0::reset;
use embassy_sync::blocking_mutex::Mutex;
use embassy_sync::blocking_mutex::raw::{CriticalSectionRawMutex, ThreadModeRawMutex};
use embassy_sync::signal::Signal;
use embassy_time::{Duration, Instant, Timer};
use static_cell::StaticCell;
use stspp_firmware_logic::controller;
use stspp_firmware_logic::hardware::SystemAction;
use stspp_protocol::wire::MAX_FRAME_LEN;

/// The controller on this hardware.
pub(crate) type Controller = controller::Controller<Engine, Store>;

/// Something for the supervisor to look at; interrupts signal it.
pub(crate) static WAKE: Signal<CriticalSectionRawMutex, ()> = Signal::new();

/// An event waits for the host.
pub(crate) static EVENT: Signal<ThreadModeRawMutex, ()> = Signal::new();

// A reference, so that the controller itself lies in .bss: an `Option` of it would be initialised
// data, which takes flash.
static CONTROLLER: Mutex<ThreadModeRawMutex, RefCell<Option<&'static mut Controller>>> =
    Mutex::const_new(ThreadModeRawMutex::new(), RefCell::new(None));

/// Puts the controller in its place; it is made there, not on the stack.
pub(crate) fn install(make: impl FnOnce() -> Controller) {
    static PLACE: StaticCell<Controller> = StaticCell::new();
    let controller = PLACE.init_with(make);
    CONTROLLER.lock(|cell| cell.replace(Some(controller)));
}

/// Runs `f` on the controller with the device time. Slots that have finished are told to it first,
/// in order, so that every answer is about what has happened.
pub(crate) fn with_controller<R>(f: impl FnOnce(&mut Controller, u64) -> R) -> R {
    CONTROLLER.lock(|cell| {
        let mut slot = cell.borrow_mut();
        let Some(controller) = slot.as_mut() else { panic!() };
        deliver(controller);
        let answer = f(controller, Instant::now().as_micros());
        settle(controller);
        answer
    })
}

/// Hands over the engine's reports. Not inlined: `with_controller` is instantiated a dozen times.
#[inline(never)]
fn deliver(controller: &mut Controller) {
    while let Some(done) = engine::take_report() {
        controller.on_slot_done(Instant::now().as_micros(), &done);
    }
}

#[inline(never)]
fn settle(controller: &mut Controller) {
    safety::keep_faults(controller.latched());
    if controller.has_event() {
        EVENT.signal(());
    }
}

/// Takes the next event as a frame, if one waits.
#[inline(never)]
pub(crate) fn take_event(out: &mut [u8; MAX_FRAME_LEN]) -> Option<usize> {
    with_controller(|controller, _| controller.next_event(out))
}

/// Takes bytes of the link; see the controller's `receive`.
#[inline(never)]
fn receive(bytes: &mut &[u8], out: &mut [u8; MAX_FRAME_LEN]) -> Option<usize> {
    with_controller(|controller, now_us| controller.receive(now_us, bytes, out))
}

/// Where replies go.
pub(crate) trait ReplySink {
    /// Sends a frame; a link that is down drops it.
    async fn send(&mut self, frame: &[u8]);
}

/// Answers the requests in `bytes`, then does what a request asked of the board.
pub(crate) async fn serve(mut bytes: &[u8], sink: &mut impl ReplySink) {
    let mut out = [0; MAX_FRAME_LEN];
    while let Some(length) = receive(&mut bytes, &mut out) {
        sink.send(&out[..length]).await;
        if let Some(action) = with_controller(|c, _| c.take_action()) {
            // The host reads the reply meanwhile; the outputs are off already.
            Timer::after(Duration::from_millis(20)).await;
            if action == SystemAction::Bootloader {
                safety::request_bootloader();
            }
            reset::software_reset();
        }
    }
}

/// Waits for the next event and writes it as a frame.
#[cfg(feature = "board-f350")]
pub(crate) async fn next_event(out: &mut [u8; MAX_FRAME_LEN]) -> usize {
    loop {
        if let Some(length) = take_event(out) {
            return length;
        }
        EVENT.wait().await;
    }
}
