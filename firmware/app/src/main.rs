//! Bring-up: blinks, logs, echoes the serial link.
#![no_std]
#![no_main]

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_gd32f3x0::{bind_interrupts, dma, gpio, peripherals, sequence, time_driver, usart};
use embassy_time::Timer;
use static_cell::StaticCell;

bind_interrupts!(struct Irqs {
    TIMER1 => time_driver::InterruptHandler, sequence::InterruptHandler;
    DMA_CHANNEL1_2 => dma::InterruptHandler;
    USART0 => usart::InterruptHandler<peripherals::USART0>;
});

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    embassy_gd32f3x0::reset::software_reset()
}

#[embassy_executor::task]
async fn blink(mut led: gpio::Output<'static>) {
    loop {
        led.toggle();
        Timer::after_millis(250).await;
    }
}

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let p = embassy_gd32f3x0::init(Default::default());
    defmt::info!("up, {}", embassy_gd32f3x0::rcu::clocks());
    let led = gpio::Output::new(p.PC13, gpio::Level::Low, gpio::Speed::Low);
    spawner.spawn(blink(led).unwrap());
    static RING: StaticCell<[u8; 256]> = StaticCell::new();
    let mut config = usart::Config::default();
    config.baud = 2_000_000;
    let (mut tx, mut rx) = usart::new(
        p.USART0,
        p.PA9,
        p.PA10,
        p.DMA_CH1,
        p.DMA_CH2,
        RING.init([0; 256]),
        Irqs,
        config,
    )
    .unwrap();
    let mut buffer = [0; 64];
    loop {
        if let Ok(n) = rx.read(&mut buffer).await {
            let _ = tx.write(&buffer[..n]).await;
        }
    }
}
