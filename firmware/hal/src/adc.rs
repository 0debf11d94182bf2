//! Converter (user manual, "Analog-to-digital converter (ADC)"): single conversions on demand.

use crate::Peri;
use crate::gpio::{self, Pin};
use crate::interrupt::typelevel::{self, Binding, Handler};
use crate::interrupt::{Interrupt, InterruptExt};
use crate::peripherals::ADC;
use crate::regs::{self, RegExt};
use core::future::poll_fn;
use core::task::Poll;
use embassy_sync::waitqueue::AtomicWaker;

static WAKER: AtomicWaker = AtomicWaker::new();

// ADC_CTL1.
const ADCON: u32 = 1 << 0;
const CLB: u32 = 1 << 2;
const RSTCLB: u32 = 1 << 3;
const ETSRC_SOFTWARE: u32 = 0b111 << 17;
const ETERC: u32 = 1 << 20;
const SWRCST: u32 = 1 << 22;
const TSVREN: u32 = 1 << 23;
// ADC_CTL0 and ADC_STAT.
const EOCIE: u32 = 1 << 5;
const EOC: u32 = 1 << 1;

/// A pin that is an analog input.
pub trait AnalogPin: Pin {
    /// Channel that it is connected to.
    const CHANNEL: u8;
}

macro_rules! analog {
    ($($pin:ident = $channel:literal;)*) => {
        $(impl AnalogPin for crate::peripherals::$pin { const CHANNEL: u8 = $channel; })*
    };
}
analog! {
    PA0 = 0; PA1 = 1; PA2 = 2; PA3 = 3; PA4 = 4; PA5 = 5; PA6 = 6; PA7 = 7; PB0 = 8; PB1 = 9;
    PC0 = 10; PC1 = 11; PC2 = 12; PC3 = 13; PC4 = 14; PC5 = 15;
}

/// Something to convert.
#[derive(Clone, Copy, Debug)]
pub struct Input {
    channel: u8,
}

impl Input {
    /// The die's temperature sensor.
    pub const TEMPERATURE: Self = Self { channel: 16 };
    /// The internal reference.
    pub const VREFINT: Self = Self { channel: 17 };

    /// Makes a pin an analog input, for good.
    pub fn pin<P: AnalogPin>(pin: Peri<'static, P>) -> Self {
        gpio::set_analog(&*pin);
        Self { channel: P::CHANNEL }
    }
}

/// The converter, calibrated.
pub struct Adc<'d> {
    _adc: Peri<'d, ADC>,
}

impl<'d> Adc<'d> {
    /// Clocks, switches on and calibrates it (about 0.1 ms).
    pub fn new(
        adc: Peri<'d, ADC>,
        _irq: impl Binding<typelevel::ADC_CMP, InterruptHandler>,
    ) -> Self {
        let rcu = regs::rcu();
        rcu.apb2en.modify(|_, w| w.adcen().set_bit());
        // Clock = APB2 / 2: 21 or 24 MHz, below the 28 MHz of the data sheet (RCU_CFG2 ADCSEL,
        // RCU_CFG0 ADCPSC = 0).
        rcu.cfg2.modify(|_, w| w.adcsel().set_bit());
        let regs = regs::adc();
        // 239.5 cycles of sampling on every channel: 10 us, for the sensor (data sheet: 17.1 us
        // in all) and for the thermistor's source resistance.
        regs.sampt0.set(0o77_777_777);
        regs.sampt1.set(0o7_777_777_777);
        regs.ctl1.set(ADCON | TSVREN | ETERC | ETSRC_SOFTWARE);
        // The manual asks for 14 converter clocks between switching on and calibrating; the
        // sensor's start-up is 10 us.
        cortex_m::asm::delay(crate::rcu::clocks().ahb_hz / 1_000_000 * 20);
        for start in [RSTCLB, CLB] {
            regs.ctl1.update(|bits| bits | start);
            while regs.ctl1.get() & start != 0 {}
        }
        regs.rsq0.set(0);
        // SAFETY: bound, by the constructor's parameter.
        unsafe { Interrupt::ADC_CMP.enable() };
        Self { _adc: adc }
    }

    /// Converts once: 12 bits, right-aligned. Dropping the future abandons the result.
    pub async fn read(&mut self, input: Input) -> u16 {
        let regs = regs::adc();
        regs.rsq2.set(u32::from(input.channel));
        regs.stat.set(!EOC & 0x1f);
        regs.ctl0.update(|bits| bits | EOCIE);
        regs.ctl1.update(|bits| bits | SWRCST);
        poll_fn(|cx| {
            WAKER.register(cx.waker());
            if regs.stat.get() & EOC != 0 { Poll::Ready(()) } else { Poll::Pending }
        })
        .await;
        // Reading the data clears EOC.
        (regs.rdata.get() & 0xfff) as u16
    }
}

/// Handler of the converter's interrupt.
pub struct InterruptHandler;

impl Handler<typelevel::ADC_CMP> for InterruptHandler {
    unsafe fn on_interrupt() {
        // Masked rather than cleared: the flag is the future's condition.
        regs::adc().ctl0.update(|bits| bits & !EOCIE);
        WAKER.wake();
    }
}
