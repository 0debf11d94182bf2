//! [`Cpu`] by the `rsemu` crate's ARMv7E-M interpreter.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use rsemu::core::BusError;
use rsemu::core::space::{
    AddressSpace, DispatchPolicy, MemAttrs, MemOps, MemResult, Perms, RamStore, Region,
    UnassignedPolicy,
};
use rsemu::core::value::{Endian, Width};
use rsemu::cpu::arm::v7m::{ArmV7m, Config, xpsr};

use super::{Bus, BusFault, Cpu, SharedMemory};

/// Memory that rsemu executes from.
struct Store(Arc<RamStore>);

impl SharedMemory for Store {
    fn bytes(&self) -> u32 {
        self.0.len() as u32
    }

    fn read(&self, offset: u32, bytes: u32) -> u32 {
        self.0.read_value(u64::from(offset), width(bytes), Endian::Little).map_or(0, |v| v as u32)
    }

    fn write(&self, offset: u32, bytes: u32, value: u32) {
        // An access beyond the end is dropped, as the trait says.
        let _ =
            self.0.write_value(u64::from(offset), width(bytes), u64::from(value), Endian::Little);
    }
}

/// A memory of `bytes` bytes: the part for [`RsemuCpu::new`] and the part for everybody else.
#[must_use]
pub fn shared_memory(bytes: u32) -> (Arc<RamStore>, Arc<dyn SharedMemory>) {
    let store = Arc::new(RamStore::new(u64::from(bytes)));
    (Arc::clone(&store), Arc::new(Store(store)))
}

fn width(bytes: u32) -> Width {
    match bytes {
        1 => Width::U8,
        2 => Width::U16,
        _ => Width::U32,
    }
}

/// A window of the address map that goes to the [`Bus`].
struct Window<B> {
    base: u32,
    bus: Arc<Mutex<B>>,
}

impl<B> fmt::Debug for Window<B> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Window({:#010x})", self.base)
    }
}

impl<B: Bus> MemOps for Window<B> {
    fn read(&self, offset: u64, dst: &mut [u8], attrs: MemAttrs) -> MemResult {
        if attrs.debug {
            return Err(BusError::BadAccess);
        }
        let mut bus = self.bus.lock().unwrap_or_else(PoisonError::into_inner);
        let word = bus
            .read(self.base + offset as u32, dst.len() as u32)
            .map_err(|BusFault| BusError::BadAccess)?;
        dst.copy_from_slice(&word.to_le_bytes()[..dst.len()]);
        Ok(())
    }

    fn write(&self, offset: u64, src: &[u8], _attrs: MemAttrs) -> MemResult {
        let mut word = [0; 4];
        word[..src.len()].copy_from_slice(src);
        let mut bus = self.bus.lock().unwrap_or_else(PoisonError::into_inner);
        bus.write(self.base + offset as u32, src.len() as u32, u32::from_le_bytes(word))
            .map_err(|BusFault| BusError::BadAccess)
    }
}

/// The core on its bus.
pub struct RsemuCpu {
    core: ArmV7m,
    space: Arc<AddressSpace>,
    irqs: u128,
    debug_events: u32,
}

/// The debug fault status register, which rsemu reads as 0 (it has no debug unit).
const DFSR: u32 = 0xe000_ed30;

/// Look-up of addresses by 16 KiB pages up to the USB core.
const PAGES: DispatchPolicy = DispatchPolicy::Dense { page_bits: 14, cover: 0x5004_0000 };

/// Where the flash lies, and where it appears a second time for the reset vectors.
const FLASH_BASES: [u64; 2] = [0x0800_0000, 0];
const RAM_BASE: u64 = 0x2000_0000;

impl RsemuCpu {
    /// A core with `flash` at 0x0800_0000 and at 0 (read and execute; writes go to the bus), `ram`
    /// at 0x2000_0000, and everything else on `bus`.
    #[must_use]
    pub fn new<B: Bus + 'static>(
        flash: Arc<RamStore>,
        ram: Arc<RamStore>,
        bus: &Arc<Mutex<B>>,
    ) -> Self {
        let space = AddressSpace::new("core", 32)
            .with_unassigned(UnassignedPolicy::FAULT)
            .with_dispatch(PAGES);
        let flash_bytes = flash.len();
        {
            let mut map = space.topology();
            let flash = Arc::new(Region::ram("flash", flash));
            for base in FLASH_BASES {
                let writes = Region::io("flash writes", flash_bytes, window(base as u32, bus));
                let mapped = map
                    .map_with_perms(writes, base, Perms::WRITE)
                    .and_then(|_| map.map_with_perms(Arc::clone(&flash), base, Perms::RX));
                mapped.expect("the fixed memory map has no overlaps that rsemu refuses");
            }
            map.map(Region::ram("ram", ram), RAM_BASE).expect("the fixed memory map is valid");
            for (name, base, bytes) in [
                ("system memory", 0x1fff_0000u32, 0x1_0000u64),
                ("peripherals", 0x4000_0000, 0x3_0000),
                ("ports", 0x4800_0000, 0x2000),
                ("usb", 0x5000_0000, 0x4_0000),
                ("debug", 0xe004_2000, 0x400),
            ] {
                map.map(Region::io(name, bytes, window(base, bus)), u64::from(base))
                    .expect("the fixed memory map is valid");
            }
        }
        let space = Arc::new(space);
        let core = Self::fresh_core(&space);
        Self { core, space, irqs: 0, debug_events: 0 }
    }

    fn fresh_core(space: &Arc<AddressSpace>) -> ArmV7m {
        // Four priority bits (SVD: nvicPrioBits).
        let core = ArmV7m::new(Config::CORTEX_M4F.with_priority_bits(4));
        core.attach_space(Arc::clone(space));
        core
    }
}

impl RsemuCpu {
    /// Whether the next instruction loads (true) or stores a word of [`DFSR`], and its register. The
    /// forms that compilers use: immediate offsets and a register offset.
    fn debug_access(&self) -> Option<(bool, u8)> {
        let pc = u64::from(self.core.pc());
        let half = |at| self.space.read(at, Width::U16, MemAttrs::DEBUG).unwrap_or(0) as u32;
        let (first, second) = (half(pc), half(pc + 2));
        let reg = |number: u32| self.core.reg(number as u8 & 15);
        let (load, address, register) = match first >> 11 {
            0b01100 | 0b01101 => {
                let offset = (first >> 6 & 31) * 4;
                (first >> 11 & 1, reg(first >> 3 & 7).wrapping_add(offset), first & 7)
            }
            0b01010 | 0b01011 if matches!(first >> 9, 0b010_1000 | 0b010_1100) => {
                let address = reg(first >> 3 & 7).wrapping_add(reg(first >> 6 & 7));
                (first >> 11 & 1, address, first & 7)
            }
            _ => {
                let base = reg(first);
                let address = match first & 0xffe0 {
                    0xf8c0 => base.wrapping_add(second & 0xfff),
                    0xf840 if second & 0xd00 == 0xc00 && second >> 9 & 1 == 0 => {
                        base.wrapping_sub(second & 0xff)
                    }
                    _ => return None,
                };
                (first >> 4 & 1, address, second >> 12)
            }
        };
        (address == DFSR).then_some((load != 0, register as u8))
    }

    /// One step of a program that may look at the debug events.
    fn step_after_debug_event(&mut self) -> u64 {
        let access = self.debug_access();
        let stored = access.map_or(0, |(_, register)| self.core.reg(register));
        let before = self.core.xpsr();
        let cycles = self.core.step();
        // An interrupt may have come instead of the instruction.
        let executed = (self.core.xpsr() ^ before) & xpsr::EXCEPTION == 0;
        match access.filter(|_| executed) {
            Some((true, register)) => self.core.set_reg(register, self.debug_events),
            Some((false, _)) => self.debug_events &= !stored,
            None => {}
        }
        cycles
    }

    /// rsemu 0.0.7 drops ITSTATE from the xPSR that exception entry stacks (the architecture keeps
    /// it: DDI 0403E B1.5.6), so what was left of an interrupted IT block would run unconditionally
    /// after the return. Where an interrupt came before the instruction at `pc` of an IT block, the
    /// frame gets the bits back.
    fn restore_it_state(&self, before: u32, pc: u32) {
        let now = self.core.xpsr();
        if now & xpsr::EXCEPTION == before & xpsr::EXCEPTION {
            return;
        }
        let frame = u64::from(self.core.reg(13));
        let read = |at: u64| self.space.read(at, Width::U32, MemAttrs::DEBUG).unwrap_or(0) as u32;
        if read(frame + 24) == pc {
            let stacked = read(frame + 28) | before & xpsr::IT_MASK;
            // The frame was just written there; it is RAM.
            let _ = self.space.write(frame + 28, Width::U32, u64::from(stacked), MemAttrs::DEBUG);
        }
    }
}

fn window<B: Bus + 'static>(base: u32, bus: &Arc<Mutex<B>>) -> Arc<dyn MemOps> {
    Arc::new(Window { base, bus: Arc::clone(bus) })
}

impl Cpu for RsemuCpu {
    fn step(&mut self) -> u64 {
        let before = self.core.xpsr();
        if before & xpsr::IT_MASK == 0 {
            if self.debug_events != 0 {
                return self.step_after_debug_event();
            }
            return self.core.step();
        }
        let pc = self.core.pc();
        let cycles = self.core.step();
        self.restore_it_state(before, pc);
        cycles
    }

    fn set_irq(&mut self, irq: u16, high: bool) {
        self.core.set_irq(irq, high);
        self.irqs = self.irqs & !(1 << irq) | u128::from(high) << irq;
    }

    fn raise_nmi(&mut self) {
        self.core.with_sys(|sys| {
            sys.set_pending(rsemu::cpu::arm::v7m::sys::Exception::NMI, true);
        });
    }

    fn set_debug_events(&mut self, events: u32) {
        self.debug_events = events;
    }

    fn is_idle(&self) -> bool {
        if !self.core.is_asleep() || self.core.reset_pending() {
            return false;
        }
        let irqs = self.irqs;
        self.core.with_sys(|sys| {
            sys.highest_pending().is_none()
                && (0..128)
                    .filter(|irq| irqs >> irq & 1 != 0)
                    .all(|irq| !sys.is_enabled(rsemu::cpu::arm::v7m::sys::Exception(16 + irq)))
        })
    }

    fn is_locked_up(&self) -> bool {
        self.core.is_locked_up()
    }

    fn skip(&mut self, cycles: u64) {
        self.core.with_sys(|sys| {
            sys.tick_cyccnt(cycles);
            if sys.tick_systick(cycles) && sys.syst_csr & 2 != 0 {
                sys.set_pending(rsemu::cpu::arm::v7m::sys::Exception::SYSTICK, true);
            }
        });
    }

    fn own_deadline(&self) -> Option<u64> {
        self.core.with_sys(|sys| (sys.syst_csr & 3 == 3).then(|| u64::from(sys.syst_cvr.max(1))))
    }

    fn take_reset_request(&mut self) -> bool {
        let asked = self.core.reset_requested();
        if asked {
            self.core.clear_reset_request();
        }
        asked
    }

    fn reset(&mut self) {
        self.core = Self::fresh_core(&self.space);
        self.irqs = 0;
    }

    fn pc(&self) -> u32 {
        self.core.pc()
    }

    fn set_pc(&mut self, pc: u32) {
        self.core.set_pc(pc);
    }

    fn set_register(&mut self, index: u8, value: u32) {
        self.core.set_reg(index.min(12), value);
    }

    fn registers(&self) -> [u32; 17] {
        let regs = self.core.regs();
        let mut all = [0; 17];
        all[..16].copy_from_slice(&regs.r);
        all[16] = regs.xpsr;
        all
    }
}
