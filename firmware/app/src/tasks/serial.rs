//! The serial link: requests from the receive ring, replies and events on one line.

use crate::shared::{self, ReplySink};
use embassy_futures::yield_now;
use embassy_gd32f3x0::peripherals::USART0;
use embassy_gd32f3x0::usart::{Error, Reader, Writer};
use embassy_sync::blocking_mutex::raw::ThreadModeRawMutex;
use embassy_sync::mutex::Mutex;
use static_cell::StaticCell;
use stspp_protocol::wire::MAX_FRAME_LEN;

/// The line: who holds it sends the events that wait, then its own frame.
pub(crate) type Line = Mutex<ThreadModeRawMutex, Wire>;

/// What sends.
pub(crate) struct Wire {
    writer: Writer<USART0>,
    event: [u8; MAX_FRAME_LEN],
}

/// Makes the writer shareable.
pub(crate) fn share(writer: Writer<USART0>) -> &'static Line {
    static LINE: StaticCell<Line> = StaticCell::new();
    LINE.init(Mutex::new(Wire { writer, event: [0; MAX_FRAME_LEN] }))
}

impl Wire {
    /// Events go before everything else: a host can ask again, but a label that was dropped costs a
    /// frame. An event leaves the outbox only here, with the line in hand, so they stay in order.
    async fn send_events(&mut self) {
        while let Some(length) = shared::take_event(&mut self.event) {
            write(&mut self.writer, &self.event[..length]).await;
        }
    }
}

async fn write(writer: &mut Writer<USART0>, frame: &[u8]) {
    if let Err(error) = writer.write(frame).await {
        defmt::error!("serial: {}", error);
    }
}

struct Replies {
    line: &'static Line,
}

impl ReplySink for Replies {
    async fn send(&mut self, frame: &[u8]) {
        let mut wire = self.line.lock().await;
        wire.send_events().await;
        write(&mut wire.writer, frame).await;
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

/// Events of a quiet line; on a busy one the replies take them along.
#[embassy_executor::task]
pub(crate) async fn events(line: &'static Line) {
    loop {
        shared::EVENT.wait().await;
        line.lock().await.send_events().await;
    }
}
