//! Ctrl-C: the light goes off at once, the verb ends without partial output.
//!
//! A verb that streams ends by itself; any other is ended here.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use stspp::pipeline::StopHandle;

use crate::exit::{Failure, Kind};

static INTERRUPTED: AtomicBool = AtomicBool::new(false);
/// Whether the verb looks for interrupts itself.
static WATCHED: AtomicBool = AtomicBool::new(false);
static STREAMS: Mutex<Vec<StopHandle>> = Mutex::new(Vec::new());

/// Installs the handler; call once.
pub fn install() {
    // Where handlers are not to be had, Ctrl-C ends the process; the device misses its heartbeat and
    // goes dark by itself.
    let _ = ctrlc::set_handler(|| {
        let again = INTERRUPTED.swap(true, Ordering::AcqRel);
        if again || !WATCHED.load(Ordering::Acquire) {
            stspp::export::folder::discard_unfinished();
            eprintln!("error: interrupted; nothing was left behind");
            std::process::exit(Kind::Interrupted as i32);
        }
        for stream in STREAMS.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
            stream.stop();
        }
    });
}

/// Stops `stream` when interrupted; from here on the verb has to [`check`].
pub fn stops(stream: StopHandle) {
    WATCHED.store(true, Ordering::Release);
    STREAMS.lock().unwrap_or_else(PoisonError::into_inner).push(stream.clone());
    if INTERRUPTED.load(Ordering::Acquire) {
        stream.stop();
    }
}

/// An error when interrupted.
pub fn check() -> Result<(), Failure> {
    if INTERRUPTED.load(Ordering::Acquire) {
        return Err(Failure::new(Kind::Interrupted, "interrupted; nothing was left behind"));
    }
    Ok(())
}
