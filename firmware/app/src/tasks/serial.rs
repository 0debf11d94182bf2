//! The serial link: requests from the receive ring, replies and events on one line.

use crate::shared::{self, ReplySink};
use embassy_futures::yield_now;
use embassy_gd32f3x0::peripherals::USART0;
use embassy_gd32f3x0::usart::{Error, Reader, Writer};
use embassy_sync::blocking_mutex::raw::ThreadModeRawMutex;
use embassy_sync::mutex::Mutex;
use static_cell::StaticCell;
use stspp_protocol::wire::MAX_FRAME_LEN;

/// The line, a frame at a time.
pub(crate) type Line = Mutex<ThreadModeRawMutex, Writer<USART0>>;

/// Makes the writer shareable.
pub(crate) fn share(writer: Writer<USART0>) -> &'static Line {
    static LINE: StaticCell<Line> = StaticCell::new();
    LINE.init(Mutex::new(writer))
}

struct Replies {
    line: &'static Line,
}

impl ReplySink for Replies {
    async fn send(&mut self, frame: &[u8]) {
        write(self.line, frame).await;
    }
}

async fn write(line: &'static Line, frame: &[u8]) {
    if let Err(error) = line.lock().await.write(frame).await {
        defmt::error!("serial: {}", error);
    }
}

/// Requests and replies.
#[embassy_executor::task]
pub(crate) async fn link(mut reader: Reader<USART0>, line: &'static Line) {
    let mut bytes = [0; 64];
    let mut replies = Replies { line };
    loop {
        match reader.read(&mut bytes).await {
            Ok(count) => shared::serve(&bytes[..count], &mut replies).await,
            Err(Error::Overrun { lost }) => shared::with_controller(|c, _| c.on_overrun(lost)),
            Err(error) => {
                // A bus error of the receiver's DMA: nothing will come any more. The heartbeat
                // ends the light; a reset brings the link back.
                defmt::error!("serial: {}", error);
                panic!("receive DMA");
            }
        }
        // However fast the host is, the other tasks get their turn.
        yield_now().await;
        let errors = reader.take_line_errors();
        if errors != 0 {
            defmt::debug!("serial: {=u32} line errors", errors);
        }
    }
}

/// Events.
#[embassy_executor::task]
pub(crate) async fn events(line: &'static Line) {
    let mut out = [0; MAX_FRAME_LEN];
    loop {
        let length = shared::next_event(&mut out).await;
        write(line, &out[..length]).await;
    }
}
