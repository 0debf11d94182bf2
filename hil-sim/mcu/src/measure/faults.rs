//! Every way in which light must end: the cause is applied while a projector is lit, the time to the
//! last gate's fall is measured, and what follows is checked: no light again, a latched reason that
//! survives a reset, refusal to arm until the faults are cleared.

use stspp_hil_sim::device::Controller;
use stspp_protocol::fault::{FaultReason, FaultSet};
use stspp_protocol::message::{Reply, Request};
use stspp_protocol::reply::RequestError;
use stspp_protocol::request::{Arm, ClearFaults, GetFaults, Heartbeat, SetTiming, StartStream};
use stspp_protocol::timing::ProjectionTiming;

use super::timing::{is_light, last_fall_ns};
use crate::controller::McuController;
use crate::session::{CallError, Session};
use crate::soc::Variant;
use crate::soc::peripheral::ResetCause;

/// A cause of darkness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Cause {
    /// The interlock opens.
    Interlock,
    /// The host falls silent.
    HeartbeatLost,
    /// The USB bus is suspended (F350).
    UsbSuspend,
    /// The cable is pulled.
    CablePulled,
    /// The firmware panics.
    Panic,
    /// The processor faults.
    HardFault,
    /// The processor hangs with all interrupts masked.
    Hang,
    /// A debugger halts the processor.
    DebugHalt,
    /// The projectors are too hot.
    OverTemperature,
    /// The temperature sensor breaks off.
    SensorOpen,
    /// The DMA channel that makes the edges stops.
    EdgeDma,
    /// The timer that counts time and makes the edges stops.
    TimerStops,
    /// The crystal stops.
    CrystalStops,
    /// The supply fails for a millisecond.
    BrownOut,
    /// The reset pin is pulled.
    ResetPin,
}

impl Cause {
    /// Every cause.
    pub const ALL: [Cause; 15] = [
        Cause::Interlock,
        Cause::HeartbeatLost,
        Cause::UsbSuspend,
        Cause::CablePulled,
        Cause::Panic,
        Cause::HardFault,
        Cause::Hang,
        Cause::DebugHalt,
        Cause::OverTemperature,
        Cause::SensorOpen,
        Cause::EdgeDma,
        Cause::TimerStops,
        Cause::CrystalStops,
        Cause::BrownOut,
        Cause::ResetPin,
    ];

    /// Whether the cause exists on a board.
    #[must_use]
    pub fn applies_to(self, variant: Variant) -> bool {
        self != Cause::UsbSuspend || variant == Variant::F350
    }

    /// What happens, in words.
    #[must_use]
    pub const fn describe(self) -> &'static str {
        match self {
            Cause::Interlock => "interlock opens",
            Cause::HeartbeatLost => "host falls silent",
            Cause::UsbSuspend => "USB bus suspended",
            Cause::CablePulled => "link cable pulled",
            Cause::Panic => "firmware panic",
            Cause::HardFault => "processor fault",
            Cause::Hang => "processor hangs, interrupts masked",
            Cause::DebugHalt => "debugger halts the processor",
            Cause::OverTemperature => "projectors too hot",
            Cause::SensorOpen => "temperature sensor open",
            Cause::EdgeDma => "edge DMA stops",
            Cause::TimerStops => "edge and time base timer stops",
            Cause::CrystalStops => "crystal stops",
            Cause::BrownOut => "supply fails",
            Cause::ResetPin => "reset pin pulled",
        }
    }

    /// The bound on the time from the cause to darkness, nanoseconds.
    #[must_use]
    pub const fn bound_ns(self, variant: Variant) -> u64 {
        // Longest on-time of the board plus the guard's margin: nothing stays on for longer.
        const GUARD_NS: u64 = 41_000_000;
        const HEARTBEAT_NS: u64 = 1_010_000_000;
        match (self, variant) {
            (Cause::Interlock, _) => 10_000,
            (Cause::HeartbeatLost, _) | (Cause::CablePulled, Variant::F330) => HEARTBEAT_NS,
            // 3 ms of idle bus are a suspend (USB 2.0, 7.1.7.6).
            (Cause::UsbSuspend | Cause::CablePulled, _) => 10_000_000,
            (Cause::Panic | Cause::HardFault, _) => 10_000,
            // Two slots may be committed; each ends by itself or by the guard.
            (Cause::Hang | Cause::DebugHalt, _) => 150_000_000,
            (Cause::OverTemperature | Cause::SensorOpen, _) => 60_000_000,
            // The supervisor comes round every 5 ms.
            (Cause::EdgeDma, _) => 6_000_000,
            (Cause::TimerStops, _) => GUARD_NS,
            (Cause::CrystalStops, _) => 10_000,
            (Cause::BrownOut | Cause::ResetPin, _) => 1_000,
        }
    }

    /// Reasons of which one must be latched afterwards; none where the cause leaves no trace in RAM.
    #[must_use]
    pub const fn reasons(self, variant: Variant) -> &'static [FaultReason] {
        match (self, variant) {
            (Cause::Interlock, _) => &[FaultReason::Interlock],
            (Cause::HeartbeatLost, _) | (Cause::CablePulled, Variant::F330) => {
                &[FaultReason::HeartbeatLost]
            }
            (Cause::UsbSuspend | Cause::CablePulled, _) => &[FaultReason::LinkLost],
            (Cause::Panic, _) => &[FaultReason::Panic],
            (Cause::HardFault, _) => &[FaultReason::HardFault],
            (Cause::Hang, _) => &[FaultReason::Watchdog],
            (Cause::DebugHalt, _) => &[FaultReason::DebugHalt],
            (Cause::OverTemperature, _) => &[FaultReason::OverTemperature],
            (Cause::SensorOpen, _) => &[FaultReason::TemperatureSensor],
            (Cause::EdgeDma, _) => &[FaultReason::EdgeDma],
            // The guard's interrupt; or, where no task can run any more, the watchdog.
            (Cause::TimerStops, _) => &[FaultReason::OnTime, FaultReason::Watchdog],
            (Cause::CrystalStops, _) => &[FaultReason::Clock],
            (Cause::BrownOut | Cause::ResetPin, _) => &[],
        }
    }

    fn apply(self, session: &mut Session<McuController>) {
        let controller = &mut session.controller;
        match self {
            Cause::Interlock => controller.set_interlock_closed(false),
            Cause::HeartbeatLost => {}
            Cause::UsbSuspend => controller.set_bus_suspended(true),
            Cause::CablePulled => controller.set_link_connected(false),
            Cause::Panic => {
                let image = controller.image();
                let location =
                    image.any_panic_location().expect("the firmware has panic locations");
                let function = ["panic_const_div_by_zero", "panic_already_borrowed", "panic_const"]
                    .iter()
                    .find_map(|name| image.symbol_containing(&["panicking", name]))
                    .expect("the firmware can panic");
                controller.chip().call(function, location);
            }
            // Nothing is mapped there: the fetch is a bus fault.
            Cause::HardFault => controller.chip().jump_to(0x6000_0000),
            Cause::Hang => controller.chip().hang(),
            Cause::DebugHalt => controller.chip().set_debug_halt(true),
            Cause::OverTemperature => controller.set_temperature_c(95.0),
            Cause::SensorOpen => {
                let channel = controller.board().thermistor_channel;
                controller.chip().soc().adc.set_volts(channel, crate::soc::adc::VDDA_V);
            }
            Cause::TimerStops => {
                // TIMER1_CTL0.CEN.
                use crate::soc::peripheral::{Peripheral, TimerId};
                controller.chip().act(|soc, cx| soc.timers[TimerId::T1.index()].write(0, 0, cx));
            }
            Cause::CrystalStops => controller.chip().set_crystal(false),
            Cause::EdgeDma => {
                controller.chip().act(|soc, cx| {
                    // Channel 3's control register, as a stray write would clear it.
                    use crate::soc::peripheral::Peripheral;
                    soc.dma.write(0x08 + 20 * 3, 0, cx);
                });
            }
            Cause::BrownOut => controller.chip().brown_out(1_000_000),
            Cause::ResetPin => controller.chip().reset(ResetCause::Pin),
        }
    }

    /// Removes the cause, as far as it is a lasting one.
    fn remove(self, session: &mut Session<McuController>) {
        match self {
            Cause::Interlock => session.controller.set_interlock_closed(true),
            Cause::UsbSuspend => session.controller.set_bus_suspended(false),
            Cause::CablePulled => session.controller.set_link_connected(true),
            Cause::DebugHalt => session.controller.chip().set_debug_halt(false),
            Cause::OverTemperature | Cause::SensorOpen => {
                session.controller.set_temperature_c(25.0)
            }
            _ => {}
        }
    }
}

/// What a cause led to.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// The cause.
    pub cause: Cause,
    /// From the cause to the last gate's fall; `None` where light went on.
    pub dark_after_ns: Option<u64>,
    /// Faults latched after the cause was gone, and after another reset.
    pub latched: FaultSet,
    /// The same after a reset by the pin.
    pub latched_after_reset: FaultSet,
    /// Whether arming was refused until the faults were cleared.
    pub refused_to_arm: bool,
    /// Whether light came back after clearing, arming and starting.
    pub recovered: bool,
    /// Gates rose by themselves after the cause.
    pub light_again: bool,
}

/// Brings a sensor to a running stream with a projector lit right now.
///
/// # Errors
/// A request was refused or not answered.
pub fn light_up(
    session: &mut Session<McuController>,
    timing: &ProjectionTiming,
) -> Result<(), CallError> {
    session.hello()?;
    session.call(Request::ClearFaults(ClearFaults))?;
    session.call(Request::SetTiming(SetTiming { timing: timing.clone() }))?;
    session.call(Request::Arm(Arm))?;
    // After a reset the emitters count as hot: the duty budget asks for a rest.
    while let Err(error) = session.call(Request::StartStream(StartStream)) {
        let CallError::Refused(RequestError::DutyBudget { retry_after_us, .. }) = error else {
            return Err(error);
        };
        session.run_for(u64::from(retry_after_us).clamp(1_000, 200_000) * 1_000);
        session.call(Request::Heartbeat(Heartbeat))?;
    }
    for _ in 0..400 {
        session.run_for(500_000);
        if session.controller.light_is_on() {
            return Ok(());
        }
    }
    Err(CallError::Timeout(200_000_000))
}

/// Applies a cause to a lit sensor and watches.
///
/// # Errors
/// The sensor did not answer before the cause, or not at all afterwards.
pub fn measure(session: &mut Session<McuController>, cause: Cause) -> Result<Outcome, CallError> {
    let variant = session.controller.chip().soc().variant();
    light_up(session, &ProjectionTiming::default())?;
    session.call(Request::Heartbeat(Heartbeat))?;
    while !session.controller.light_is_on() {
        session.run_for(200_000);
    }
    // Well into the slot's light.
    session.run_for(1_000_000);
    if matches!(cause, Cause::Panic | Cause::HardFault) {
        session.controller.chip().run_until_awake();
        session.run_for(1);
    }
    session.take_edges();
    let start_ns = session.controller.now_ns();
    let lit = session.controller.high_lines().to_vec();
    cause.apply(session);
    let watch_ns = 2 * cause.bound_ns(variant).max(300_000_000);
    let end_ns = start_ns + watch_ns;
    while session.controller.now_ns() < end_ns {
        session.run_for(20_000_000);
        // A living host keeps talking, whatever it hears.
        if cause != Cause::HeartbeatLost {
            session.send(&Request::Heartbeat(Heartbeat));
        }
    }
    let edges = session.take_edges();
    let fell_ns = last_fall_ns(&edges, lit, is_light);
    let dark_after_ns = if session.controller.light_is_on() {
        None
    } else {
        fell_ns.map(|ns| ns.saturating_sub(start_ns))
    };
    let light_again = edges
        .iter()
        .any(|e| is_light(e.line) && e.high && e.time_ns > start_ns + cause.bound_ns(variant));

    cause.remove(session);
    session.run_for(400_000_000);
    session.drop_replies();
    let latched = faults(session)?;
    session.controller.chip().reset(ResetCause::Pin);
    session.run_for(400_000_000);
    let latched_after_reset = faults(session)?;
    session.hello()?;
    let refused_to_arm = matches!(
        session.call(Request::Arm(Arm)),
        Err(CallError::Refused(RequestError::Faulted { .. } | RequestError::InterlockOpen))
    );
    let recovered = light_up(session, &ProjectionTiming::default()).is_ok();
    Ok(Outcome {
        cause,
        dark_after_ns,
        latched,
        latched_after_reset,
        refused_to_arm,
        recovered,
        light_again,
    })
}

fn faults(session: &mut Session<McuController>) -> Result<FaultSet, CallError> {
    match session.call(Request::GetFaults(GetFaults))? {
        Reply::GetFaults(report) => Ok(report.latched),
        other => unreachable!("the reply to GetFaults is {other:?}"),
    }
}
