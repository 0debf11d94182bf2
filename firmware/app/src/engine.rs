//! The gate engine on the chip: the logic's [`Runner`] over the HAL's timed port writes.

use crate::{board, safety, shared, trigger_in};
use core::cell::RefCell;
use critical_section::Mutex;
use embassy_gd32f3x0::calc::chain::Edge as PortEdge;
use embassy_gd32f3x0::sequence::Sequence;
use embassy_gd32f3x0::{exti, guard};
use embassy_time::Instant;
use heapless::{Deque, Vec};
use static_cell::StaticCell;
use stspp_firmware_logic::hardware::{Aborted, GateEngine, SlotDone, TriggerEdges};
use stspp_firmware_logic::runner::{Edge, EdgeQueue, Effect, Refused, Runner, SLOT_EDGES};
use stspp_firmware_logic::timing::{GateWord, SlotPlan};
use stspp_protocol::trigger::{TriggerEdge, TriggerSource};

/// Slots that can wait for the controller; more than that, and it sees the gap as a fault.
const REPORTS: usize = 16;

/// How much longer than allowed the guard waits, so that it never wins against the regular edge.
const GUARD_MARGIN_US: u32 = 500;

/// From a floodlight request to its edge.
const FLOODLIGHT_LEAD_US: u64 = 40;

struct Core {
    queue: PortQueue,
    runner: Runner,
    reports: Deque<SlotDone, REPORTS>,
    trigger_in: exti::RawLine,
}

/// Shared by [`Engine`] (thread mode) and the edge interrupt.
static CORE: Mutex<RefCell<Option<&'static mut Core>>> = Mutex::new(RefCell::new(None));

fn with_core<R>(f: impl FnOnce(&mut Core) -> R) -> R {
    critical_section::with(|cs| match CORE.borrow_ref_mut(cs).as_mut() {
        Some(core) => f(core),
        None => panic!(),
    })
}

/// Takes the hardware: the edges' and trigger-in's.
pub(crate) fn install(sequence: Sequence<'static>, trigger_in: exti::RawLine) {
    // In .bss, not in initialised data, and made there, not on the stack.
    static PLACE: StaticCell<Core> = StaticCell::new();
    let core = PLACE.init_with(|| Core {
        queue: PortQueue { sequence },
        runner: Runner::new(),
        reports: Deque::new(),
        trigger_in,
    });
    critical_section::with(|cs| {
        CORE.replace(cs, Some(core));
    });
}

/// Takes the oldest report.
pub(crate) fn take_report() -> Option<SlotDone> {
    with_core(|core| core.reports.pop_front())
}

/// After an edge; TIMER1's interrupt calls it.
pub(crate) fn on_edge() {
    let wake = with_core(|core| {
        let Core { queue, runner, reports, .. } = core;
        if safety::is_cut() || !runner.is_running() {
            // A floodlight pulse outside of a run, or the end of everything.
            if board::lit_pins() == 0 {
                guard::disarm();
            }
            return false;
        }
        let happened = queue.sequence.happened();
        let before = reports.len();
        let light = runner.on_events(
            happened,
            board::usb_sof,
            |done| {
                // Full: the report is lost, and the controller sees the gap.
                let _ = reports.push_back(done);
            },
            queue,
        );
        if !light.is_lit {
            guard::disarm();
        } else if light.was_dark {
            guard::arm(board::BOARD.limits().max_on_time_us + GUARD_MARGIN_US);
        }
        reports.len() != before
    });
    if wake {
        shared::WAKE.signal(());
    }
}

/// An edge at trigger-in, and more that came too close to it; the software interrupt calls it.
pub(crate) fn on_trigger_edge(at_us: u64, more: u32) {
    with_core(|core| {
        if !safety::is_cut() {
            core.runner.on_trigger_edge(at_us, more, &mut core.queue);
        }
    });
}

/// What the supervisor looks at every round: trigger-in is listened to while a run waits for it.
/// Returns how many edges were made and how many planned, where the DMA has stopped by itself.
pub(crate) fn tend() -> Option<(u32, u32)> {
    with_core(|core| {
        let cut = safety::is_cut();
        trigger_in::listen(core.runner.waits_for_edge() && !cut);
        let stopped = core.runner.is_running() && !cut && !core.queue.sequence.is_running();
        stopped.then(|| (core.queue.sequence.happened(), core.queue.sequence.appended()))
    })
}

/// The HAL's sequence as the runner's queue.
struct PortQueue {
    sequence: Sequence<'static>,
}

impl EdgeQueue for PortQueue {
    fn now_us(&self) -> u64 {
        Instant::now().as_micros()
    }

    fn restart(&mut self) {
        safety::allow();
        self.sequence.start();
        // The interlock may have opened while the DMA was being started: it must win.
        if safety::is_cut() || !safety::interlock_is_closed() {
            safety::cut();
        }
    }

    fn queue(&mut self, edges: &[Edge]) -> Result<u32, Refused> {
        let first = self.sequence.appended();
        let edges: Vec<PortEdge, SLOT_EDGES> = edges
            .iter()
            .map(|edge| PortEdge { at: edge.at_us as u32, word: board::port_word(edge.effect) })
            .collect();
        self.sequence.append(&edges).map_err(|_| Refused)?;
        Ok(first)
    }

    fn retract(&mut self, first: u32) -> Result<(), Refused> {
        self.sequence.retract(first).map_err(|_| Refused)
    }
}

/// The gate engine.
pub(crate) struct Engine;

impl GateEngine for Engine {
    fn ticks_per_us(&self) -> u32 {
        1
    }

    fn load(&mut self, plan: &SlotPlan) {
        with_core(|core| core.runner.load(plan, &mut core.queue));
    }

    fn start(&mut self, slots: Option<u32>) -> u64 {
        with_core(|core| {
            guard::disarm();
            core.reports.clear();
            let start_us = core.runner.start(slots, &mut core.queue);
            trigger_in::listen(core.runner.waits_for_edge());
            start_us
        })
    }

    fn stop(&mut self) -> u32 {
        with_core(|core| core.runner.stop(&mut core.queue))
    }

    fn force_off(&mut self) -> Aborted {
        with_core(|core| {
            safety::cut();
            guard::disarm();
            let now_us = Instant::now().as_micros();
            let since_us = (now_us as u32).wrapping_sub(safety::cut_at());
            let cut_us = now_us.saturating_sub(u64::from(since_us));
            let happened = core.queue.sequence.happened();
            let aborted = core.runner.abort(happened, cut_us);
            core.queue.sequence.stop();
            aborted
        })
    }

    fn set_floodlight(&mut self, duration_us: u32) {
        with_core(|core| {
            if duration_us == 0 {
                safety::cut();
                guard::disarm();
                return;
            }
            let edge = |at_us, gates| Edge {
                at_us,
                effect: Effect { gates: Some(gates), triggers: None },
            };
            core.queue.restart();
            // After the restart, which clears both rings and takes a good part of the lead.
            let on_us = Instant::now().as_micros() + FLOODLIGHT_LEAD_US;
            // Refused only where this was stalled for longer than the lead: then it stays dark,
            // which the controller finds at the end of the pulse.
            let _ = core.queue.queue(&[
                edge(on_us, GateWord::FLOODLIGHT_ONLY),
                edge(on_us + u64::from(duration_us), GateWord::DARK),
            ]);
            guard::arm(duration_us + FLOODLIGHT_LEAD_US as u32 + GUARD_MARGIN_US);
        });
    }

    fn floodlight_is_on(&self) -> bool {
        board::floodlight_is_on()
    }

    fn set_trigger_source(&mut self, source: TriggerSource) {
        with_core(|core| {
            core.runner.set_trigger_source(source);
            if let TriggerSource::External(external) = source {
                core.trigger_in.select(match external.edge {
                    TriggerEdge::Rising => exti::Edge::Rising,
                    TriggerEdge::Falling => exti::Edge::Falling,
                });
            }
        });
    }

    fn trigger_edges(&self) -> TriggerEdges {
        with_core(|core| core.runner.trigger_edges())
    }
}
