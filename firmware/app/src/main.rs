//! Firmware of the stspp sensor's controller, for the GD32F330 (serial link) and the GD32F350
//! (native USB).
//!
//! # Theory of operation
//!
//! ```text
//!            host
//!             |  requests, replies             events
//!   tasks::link (UART ring or USB bulk)   tasks::events (same line or USB interrupt IN)
//!             |                                ^
//!             v                                |
//!       shared::CONTROLLER  = stspp_firmware_logic::Controller: states, faults, timing, duty
//!             |       ^  slot reports       ^ temperature      ^ time-outs, faults
//!             v       |                     |                  |
//!        engine::Engine                tasks::temperature   tasks::supervisor --> watchdog
//!             | commits slots ahead         (NTC)              ^
//!             v                                                | wake
//!   TIMER1 compare --DMA--> GPIOB BOP          interrupts: edge (P1), guard (P1), interlock (P0)
//! ```
//!
//! Edges are made by a timer and DMA (`embassy_gd32f3x0::sequence`); software only fills tables
//! ahead and takes notes afterwards. The interrupt after an edge ([`engine`]) commits the next
//! slot and reports the finished one. All tasks run in one thread-mode executor; none of them is
//! needed for light to end:
//!
//! | Who | Does | If it dies |
//! |---|---|---|
//! | TIMER1 + DMA 0, 3 | every edge | guard (TIMER0 + DMA 4) switches off after the longest on-time |
//! | edge interrupt, P1 | commits the next slot | at most the committed slot is played, then dark |
//! | interlock interrupt, P0 | stops DMA, all outputs low, at once | supervisor sees the level 5 ms later |
//! | trigger-in, P0, P1 | notes the edge, commits its slot | no slot, no light |
//! | supervisor | time-outs, latches faults, feeds the watchdog | watchdog resets, reset is dark |
//! | link | requests | heartbeat runs out |
//!
//! Priorities: 0 interlock (never masked: critical sections use BASEPRI, see the HAL), 1 time,
//! edges and guard, 2 the link's and the rest. [`safety`] has the handlers that switch off first
//! and record the reason in RAM that survives the reset.
//!
//! Dropping a task's future never happens: tasks run for ever, and the futures that they drop in
//! `select` (a wait, a read) lose nothing.
#![no_std]
#![no_main]

mod board;
mod engine;
mod safety;
mod shared;
mod store;
mod tasks;
mod trigger_in;

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_gd32f3x0::interrupt::{InterruptExt, Priority};
use embassy_gd32f3x0::{
    adc, bind_interrupts, dma, exti, gpio, guard, interrupt, reset, sequence, time_driver, watchdog,
};
use stspp_firmware_logic::controller::{Boot, Controller};

bind_interrupts!(struct Irqs {
    TIMER1 => sequence::InterruptHandler, time_driver::InterruptHandler;
    TIMER0_BRK_UP_TRG_COM => guard::InterruptHandler, safety::GuardHandler;
    EXTI0_1 => safety::InterlockHandler;
    // No such peripheral is used: the vectors are software interrupts.
    I2C0_EV => safety::WakeHandler;
    I2C0_ER => trigger_in::EdgeHandler;
    ADC_CMP => adc::InterruptHandler;
    DMA_CHANNEL1_2 => dma::InterruptHandler;
    #[cfg(feature = "board-f330")]
    USART0 => embassy_gd32f3x0::usart::InterruptHandler<embassy_gd32f3x0::peripherals::USART0>;
    #[cfg(feature = "board-f350")]
    USBFS => embassy_gd32f3x0::usb::InterruptHandler;
});

/// The supervisor comes round every 5 ms at the latest, a page erase stalls for up to 40 ms.
const WATCHDOG_US: u32 = 100_000;

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    // Before anything is set up: the ROM bootloader wants the chip as reset left it.
    if safety::take_bootloader_request() {
        // SAFETY: straight after reset.
        unsafe { reset::enter_bootloader() }
    }
    let p = embassy_gd32f3x0::init(Default::default());
    let outputs = board::outputs!(p);
    let mut watchdog = watchdog::Watchdog::start(p.FWDGT, WATCHDOG_US);

    let boot: Boot = safety::boot(reset::take_cause());
    defmt::info!(
        "{=str} up after {} reset, faults carried over: {=u32:#x}",
        embassy_gd32f3x0::chip::NAME,
        boot.cause,
        boot.carried.0
    );
    let clocks = embassy_gd32f3x0::rcu::clocks();
    if clocks.crystal_failed {
        defmt::warn!("the crystal does not start: times are as good as the internal oscillator");
    }

    let output_pins = outputs.each_ref();
    let mut sequence = sequence::Sequence::new(p.TIMER1, p.DMA_CH3, p.DMA_CH0, &output_pins, Irqs);
    sequence.on_edge(engine::on_edge);
    let guard =
        guard::Guard::new(p.TIMER0, p.DMA_CH4, output_pins[0], board::OFF_WORD, Priority::P1, Irqs);
    let interlock = gpio::Input::new(p.PA0, gpio::Pull::Down);
    let line = exti::RawLine::new(&interlock, exti::Edge::Both);
    let trigger_in = gpio::Input::new(p.PA1, gpio::Pull::Down);
    let trigger_line = exti::RawLine::new(&trigger_in, exti::Edge::Rising);
    exti::RawLine::mask(board::TRIGGER_LINE);
    interrupt::I2C0_EV.set_priority(Priority::P2);
    interrupt::I2C0_ER.set_priority(Priority::P1);
    interrupt::ADC_CMP.set_priority(Priority::P2);
    interrupt::EXTI0_1.set_priority(Priority::P0);
    // SAFETY: both handlers are bound above; that of priority 0 enters no critical section.
    unsafe {
        interrupt::I2C0_EV.enable();
        interrupt::I2C0_ER.enable();
        interrupt::EXTI0_1.enable();
    }
    // The drivers live as long as the program: dropping one would let its pins float.
    core::mem::forget((outputs, guard, interlock, line, trigger_in));
    engine::install(sequence, trigger_line);

    let store = store::Store::new(p.FMC);
    shared::install(|| Controller::new(board::identity(), engine::Engine, store, boot));
    let has_usb = embassy_gd32f3x0::rcu::has_usbfs();
    shared::with_controller(|controller, _| {
        controller.on_interlock(0, safety::interlock_is_closed());
        if has_usb != board::HAS_USB {
            controller.on_wrong_board(i32::from(has_usb), i32::from(board::HAS_USB));
        }
    });
    if has_usb != board::HAS_USB {
        defmt::error!(
            "this firmware is for the {=str}, this chip is the other one: no light; flash the image of this board",
            embassy_gd32f3x0::chip::NAME
        );
    }
    watchdog.feed();

    spawner.spawn(tasks::supervisor::run(watchdog).expect("spawned once"));
    let ntc = adc::Input::pin(p.PA4);
    let adc = adc::Adc::new(p.ADC, Irqs);
    spawner.spawn(tasks::temperature::run(adc, ntc).expect("spawned once"));
    let led = gpio::Output::new(p.PC13, gpio::Level::Low, gpio::Speed::Low);
    spawner.spawn(tasks::led::run(led).expect("spawned once"));
    // A link that the chip does not have would be a bus fault; that the other one has is served, and
    // tells the host what is wrong.
    if has_usb || !board::HAS_USB {
        board::spawn_link!(spawner, p);
    }
}
