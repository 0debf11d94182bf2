//! Board with the GD32F330: protocol over USART0 (PA9, PA10) and a USB-UART bridge.

use stspp_protocol::version::{BoardKind, Capabilities};

/// Which board this is.
pub(crate) const BOARD: BoardKind = BoardKind::F330;

/// What it can do.
pub(crate) const CAPABILITIES: Capabilities = Capabilities::SETTINGS_STORE
    .union(Capabilities::BOOTLOADER)
    .union(Capabilities::FLOODLIGHT)
    .union(Capabilities::TEMPERATURE)
    .union(Capabilities::TRIGGER_IN);

/// Whether the chip of this board has a USB core.
pub(crate) const HAS_USB: bool = false;

/// There is no USB here.
pub(crate) fn usb_sof() -> Option<u16> {
    None
}

/// Starts the link's tasks.
macro_rules! spawn_link {
    ($spawner:ident, $p:ident) => {{
        use embassy_gd32f3x0::usart;
        static RING: static_cell::StaticCell<[u8; 1024]> = static_cell::StaticCell::new();
        let mut config = usart::Config::default();
        config.baud = stspp_protocol::usb::SERIAL_BAUD;
        interrupt::USART0.set_priority(Priority::P2);
        interrupt::DMA_CHANNEL1_2.set_priority(Priority::P2);
        let (writer, reader) = usart::new(
            $p.USART0,
            $p.PA9,
            $p.PA10,
            $p.DMA_CH1,
            $p.DMA_CH2,
            RING.init([0; 1024]),
            Irqs,
            config,
        )
        .expect("2 Mbaud is exact at both clocks");
        let writer = tasks::serial::share(writer);
        $spawner.spawn(tasks::serial::events(writer).expect("spawned once"));
        $spawner.spawn(tasks::serial::link(reader, writer).expect("spawned once"));
    }};
}
pub(crate) use spawn_link;
