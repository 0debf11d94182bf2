//! What the sensor's firmware leaves unused of the HAL, used through the embedded-hal traits, so that
//! the emulator's tests can hold it against the pins (`hil-sim/mcu/tests/hal.rs`):
//!
//! * PWM: TIMER14 channel 0 on PB14, 1 kHz at a quarter; TIMER2 channel 0 on PB4, 20 kHz, set by what
//!   comes over USART1;
//! * USART1 on PA2, PA3: echoes each byte plus one, and sets TIMER2's duty cycle to it, in 256ths;
//! * EXTI: each edge at PB5 is followed by PB6, each rising edge at PA7 toggles PB7;
//! * `DelayNs`, `InputPin`, `StatefulOutputPin`: PB8 gives a pulse of 250 us while PA6 is high.
#![no_std]
#![no_main]

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_gd32f3x0::Peri;
use embassy_gd32f3x0::exti::{self, ExtiInput};
use embassy_gd32f3x0::gpio::{AnyPin, Input, Level, Output, Pull, Speed};
use embassy_gd32f3x0::peripherals::{TIMER2, USART1};
use embassy_gd32f3x0::timer::Pwm;
use embassy_gd32f3x0::usart::{self, Reader, Writer};
use embassy_gd32f3x0::{bind_interrupts, dma, time_driver};
use embassy_time::Delay;
use embedded_hal::digital::{InputPin, StatefulOutputPin};
use embedded_hal::pwm::SetDutyCycle;
use embedded_hal_async::delay::DelayNs;
use embedded_hal_async::digital::Wait;
use embedded_io_async::Write;
use static_cell::StaticCell;

bind_interrupts!(struct Irqs {
    TIMER1 => time_driver::InterruptHandler;
    EXTI4_15 => exti::InterruptHandler;
    DMA_CHANNEL3_4 => dma::InterruptHandler;
    USART1 => usart::InterruptHandler<USART1>;
});

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let p = embassy_gd32f3x0::init(Default::default());
    let mut quarter = Pwm::<_, 0>::new(p.TIMER14, p.PB14, 1_000);
    let _ = quarter.set_duty_cycle_percent(25);
    core::mem::forget(quarter);
    let dimmed = Pwm::<_, 0>::new(p.TIMER2, p.PB4, 20_000);

    static RING: StaticCell<[u8; 64]> = StaticCell::new();
    let mut config = usart::Config::default();
    config.baud = 115_200;
    let (writer, reader) =
        usart::new(p.USART1, p.PA2, p.PA3, p.DMA_CH3, p.DMA_CH4, RING.init([0; 64]), Irqs, config)
            .expect("115200 baud is within 1 % at both clocks");
    spawner.spawn(echo(reader, writer, dimmed).expect("spawned once"));

    let output = |pin: Peri<'static, AnyPin>| Output::new(pin, Level::Low, Speed::High);
    // SAFETY: EXTI4_15 is bound above.
    let both = unsafe { ExtiInput::new(Input::new(p.PB5, Pull::Down)) };
    spawner.spawn(follow(both, output(p.PB6.into())).expect("spawned once"));
    // SAFETY: as above.
    let rising = unsafe { ExtiInput::new(Input::new(p.PA7, Pull::Down)) };
    spawner.spawn(toggle(rising, output(p.PB7.into())).expect("spawned once"));
    spawner
        .spawn(pulse(Input::new(p.PA6, Pull::Down), output(p.PB8.into())).expect("spawned once"));
    defmt::info!("exercise runs");
}

/// Echoes, and dims.
#[embassy_executor::task]
async fn echo(
    mut reader: Reader<USART1>,
    mut writer: Writer<USART1>,
    mut dimmed: Pwm<'static, TIMER2, 0>,
) {
    let mut bytes = [0; 16];
    loop {
        let Ok(count) = reader.read(&mut bytes).await else { continue };
        for byte in &mut bytes[..count] {
            let _ = dimmed.set_duty_cycle_fraction(u16::from(*byte), 256);
            *byte = byte.wrapping_add(1);
        }
        let _ = writer.write_all(&bytes[..count]).await;
        let _ = embedded_io_async::Write::flush(&mut writer).await;
    }
}

/// Follows an input.
#[embassy_executor::task]
async fn follow(mut input: ExtiInput<'static>, mut output: Output<'static>) {
    loop {
        let Ok(()) = input.wait_for_high().await;
        output.set_high();
        let Ok(()) = input.wait_for_low().await;
        output.set_low();
    }
}

/// Counts rising edges by two.
#[embassy_executor::task]
async fn toggle(mut input: ExtiInput<'static>, mut output: Output<'static>) {
    loop {
        let Ok(()) = input.wait_for_rising_edge().await;
        let Ok(()) = StatefulOutputPin::toggle(&mut output);
    }
}

/// Pulses while an input is high.
#[embassy_executor::task]
async fn pulse(mut input: Input<'static>, mut output: Output<'static>) {
    let mut delay = Delay;
    loop {
        if matches!(InputPin::is_high(&mut input), Ok(true)) {
            output.set_high();
            delay.delay_us(250).await;
            output.set_low();
        }
        delay.delay_ms(1).await;
    }
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    embassy_gd32f3x0::reset::software_reset()
}

#[defmt::panic_handler]
fn defmt_panic() -> ! {
    embassy_gd32f3x0::reset::software_reset()
}
