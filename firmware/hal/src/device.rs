//! Singletons, interrupts, and the HAL's start.

use crate::rcu;

embassy_hal_internal::interrupt_mod!(
    WWDGT,
    LVD,
    RTC,
    FMC,
    RCU,
    EXTI0_1,
    EXTI2_3,
    EXTI4_15,
    TSI,
    DMA_CHANNEL0,
    DMA_CHANNEL1_2,
    DMA_CHANNEL3_4,
    ADC_CMP,
    TIMER0_BRK_UP_TRG_COM,
    TIMER0_CC,
    TIMER1,
    TIMER2,
    TIMER5_DAC,
    TIMER13,
    TIMER14,
    TIMER15,
    TIMER16,
    I2C0_EV,
    I2C1_EV,
    SPI0,
    SPI1,
    USART0,
    USART1,
    CEC,
    I2C0_ER,
    I2C1_ER,
    USBFS_WKUP,
    DMA_CHANNEL5_6,
    USBFS,
);

macro_rules! device_peripherals {
    ($($extra:ident),*) => {
        embassy_hal_internal::peripherals!(
            PA0, PA1, PA2, PA3, PA4, PA5, PA6, PA7, PA8, PA9, PA10, PA11, PA12, PA13, PA14, PA15,
            PB0, PB1, PB2, PB3, PB4, PB5, PB6, PB7, PB8, PB9, PB10, PB11, PB12, PB13, PB14, PB15,
            PC0, PC1, PC2, PC3, PC4, PC5, PC6, PC7, PC8, PC9, PC10, PC11, PC12, PC13, PC14, PC15,
            PD2, PF0, PF1, PF4, PF5, PF6, PF7,
            DMA_CH0, DMA_CH1, DMA_CH2, DMA_CH3, DMA_CH4, DMA_CH5, DMA_CH6,
            TIMER0, TIMER1, TIMER2, TIMER13, TIMER14, TIMER15, TIMER16,
            USART0, USART1, ADC, FMC, FWDGT, $($extra),*
        );
    };
}

#[cfg(feature = "gd32f330")]
device_peripherals!();
#[cfg(feature = "gd32f350")]
device_peripherals!(USBFS);

pub use embassy_hal_internal::{Peri, PeripheralType};

/// Ties interrupts to drivers' handlers, checked by the drivers' constructors.
///
/// ```ignore
/// bind_interrupts!(struct Irqs {
///     USART0 => usart::InterruptHandler<peripherals::USART0>;
/// });
/// ```
#[macro_export]
macro_rules! bind_interrupts {
    ($(#[$attr:meta])* $vis:vis struct $name:ident {
        $($(#[cfg($condition:meta)])? $irq:ident => $($handler:ty),*;)*
    }) => {
        #[derive(Copy, Clone)]
        $(#[$attr])*
        $vis struct $name;

        $(
            $(#[cfg($condition)])?
            #[allow(non_snake_case)]
            #[unsafe(no_mangle)]
            unsafe extern "C" fn $irq() {
                $(
                    // SAFETY: called from this interrupt's handler and from nowhere else.
                    unsafe {
                        <$handler as $crate::interrupt::typelevel::Handler<
                            $crate::interrupt::typelevel::$irq,
                        >>::on_interrupt();
                    }
                )*
            }

            $(#[cfg($condition)])?
            const _: () = {
                $(
                    // SAFETY: the handler above calls it.
                    unsafe impl $crate::interrupt::typelevel::Binding<
                        $crate::interrupt::typelevel::$irq,
                        $handler,
                    > for $name {}
                )*
            };
        )*
    };
}

/// What [`init`] is told.
#[non_exhaustive]
#[derive(Clone, Copy, Debug)]
pub struct Config {
    /// Clock tree.
    pub rcu: rcu::Config,
    /// Priority of the time driver's interrupt (and of the sequence's, which shares TIMER1).
    pub time_priority: interrupt::Priority,
}

impl Default for Config {
    fn default() -> Self {
        Self { rcu: rcu::Config::default(), time_priority: interrupt::Priority::P1 }
    }
}

/// Starts clocks and time, and hands out the peripherals. Call it once, first thing.
///
/// # Panics
/// When called twice, or with a clock configuration that the chip cannot make.
pub fn init(config: Config) -> Peripherals {
    let peripherals = Peripherals::take();
    // Before anything can fail: a debugger that stops the core must stop no timer that ends
    // light, and must not hold the watchdog (manual, "Debug (DBG)": DBG_CTL0, DBG_CTL1).
    let dbg = crate::regs::dbg();
    crate::regs::RegExt::set(&dbg.ctl0, 0);
    crate::regs::RegExt::set(&dbg.ctl1, 0);
    rcu::init(&config.rcu);
    crate::time_driver::init(config.time_priority);
    peripherals
}
