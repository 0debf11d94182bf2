//! The address map, for the core and for the DMA controller.

use std::sync::atomic::Ordering;

use super::fmc::FLASH_BASE;
use super::peripheral::{PeripheralId, TimerId};
use super::{FLASH_BYTES, RAM_BYTES, Soc, Variant};
use crate::cpu::{Bus, BusFault, SharedMemory};
use crate::soc::registers::register_at;

const RAM_BASE: u32 = 0x2000_0000;
/// Unique device identifier, and flash and RAM size in KiB (user manual 1.5).
const UNIQUE_ID: u32 = 0x1fff_f7ac;
const DENSITY: u32 = 0x1fff_f7e0;
const OPTION_BYTES: u32 = 0x1fff_f800;

/// Which model answers at an address, and the offset in it.
fn decode(address: u32) -> Option<(PeripheralId, u32)> {
    let id = match address >> 10 << 10 {
        0x4000_0000 => PeripheralId::Timer(TimerId::T1),
        0x4000_0400 => PeripheralId::Timer(TimerId::T2),
        0x4000_2000 => PeripheralId::Timer(TimerId::T13),
        0x4000_3000 => PeripheralId::Fwdgt,
        0x4000_4400 => PeripheralId::Usart(1),
        0x4000_7000 => PeripheralId::Pmu,
        0x4000_c800 => PeripheralId::Ctc,
        0x4001_0000 => PeripheralId::Syscfg,
        0x4001_0400 => PeripheralId::Exti,
        0x4001_2400 => PeripheralId::Adc,
        0x4001_2c00 => PeripheralId::Timer(TimerId::T0),
        0x4001_3800 => PeripheralId::Usart(0),
        0x4001_4000 => PeripheralId::Timer(TimerId::T14),
        0x4001_4400 => PeripheralId::Timer(TimerId::T15),
        0x4001_4800 => PeripheralId::Timer(TimerId::T16),
        0x4002_0000 => PeripheralId::Dma,
        0x4002_1000 => PeripheralId::Rcu,
        0x4002_2000 => PeripheralId::Fmc,
        0x4002_3000 => PeripheralId::Crc,
        0x4800_0000 => PeripheralId::Gpio(0),
        0x4800_0400 => PeripheralId::Gpio(1),
        0x4800_0800 => PeripheralId::Gpio(2),
        0x4800_0c00 => PeripheralId::Gpio(3),
        0x4800_1400 => PeripheralId::Gpio(5),
        0xe004_2000 => PeripheralId::Dbg,
        _ if address >> 18 == 0x5000_0000 >> 18 => {
            return Some((PeripheralId::Usbfs, address - 0x5000_0000));
        }
        _ => return None,
    };
    Some((id, address & 0x3ff))
}

impl Soc {
    /// An access by the core or the DMA controller at cycle `now`.
    pub(super) fn bus_read(&mut self, address: u32, bytes: u32, now: u64) -> Result<u32, BusFault> {
        if let Some((memory, offset)) = self.memory(address) {
            return Ok(memory.read(offset, bytes));
        }
        if address >> 16 == 0x1fff {
            return Ok(self.system_memory(address, bytes));
        }
        let word_address = address & !3;
        let lane = 8 * (address & 3);
        let Some((id, offset)) = self.answering(word_address, now)? else { return Ok(0) };
        if self.peripheral(id).modelled(offset).is_none() {
            self.log.read(now, word_address);
            return Ok(register_at(word_address).map_or(0, |r| r.reset) >> lane);
        }
        let word = self.with(now, |soc, cx| soc.peripheral(id).read(offset, cx));
        self.route(now);
        Ok(word >> lane)
    }

    pub(super) fn bus_write(
        &mut self,
        address: u32,
        bytes: u32,
        value: u32,
        now: u64,
    ) -> Result<(), BusFault> {
        if let Some((memory, offset)) = self.memory(address) {
            if address >= RAM_BASE {
                memory.write(offset, bytes, value);
            } else {
                self.with(now, |soc, cx| soc.fmc.program(offset, bytes, value, cx));
                self.route(now);
            }
            return Ok(());
        }
        let word_address = address & !3;
        let Some((id, offset)) = self.answering(word_address, now)? else { return Ok(()) };
        if address & 3 != 0 {
            let name = register_at(word_address)
                .map_or_else(|| format!("{word_address:#010x}"), |r| r.name.clone());
            self.log.note(
                now,
                format!("{name} written by {bytes} bytes at lane {}: not modelled", address & 3),
            );
            return Ok(());
        }
        let modelled = self.peripheral(id).modelled(offset);
        // The USB FIFO windows are no registers.
        if !(id == PeripheralId::Usbfs && offset >= 0x1000) {
            self.log.write(now, word_address, value, modelled);
        }
        if modelled.is_some() {
            self.with(now, |soc, cx| soc.peripheral(id).write(offset, value, cx));
            self.route(now);
        }
        Ok(())
    }

    /// The peripheral at `address` if its clock is on; `None` (and a note) where it is off or has no
    /// model.
    fn answering(
        &mut self,
        address: u32,
        now: u64,
    ) -> Result<Option<(PeripheralId, u32)>, BusFault> {
        let register = register_at(address);
        let Some((id, offset)) = decode(address) else {
            let Some(register) = register else {
                self.log.note(now, format!("address {address:#010x} accessed: nothing is there"));
                return Err(BusFault);
            };
            self.log.note(now, format!("{} accessed: no model of that peripheral", register.name));
            return Ok(None);
        };
        if id == PeripheralId::Usbfs && self.variant == Variant::F330 {
            self.log.note(now, "USBFS accessed on a GD32F330, which has none".to_string());
            return Err(BusFault);
        }
        let (on, gate) = self.rcu.clock_gate(id);
        if !on {
            let name = register.map_or_else(|| format!("{id:?}"), |r| r.name.clone());
            self.log.note(now, format!("{name} accessed while {gate} is off"));
            return Ok(None);
        }
        Ok(Some((id, offset)))
    }

    fn memory(&self, address: u32) -> Option<(&dyn SharedMemory, u32)> {
        match address {
            _ if address < FLASH_BYTES => Some((&*self.flash, address)),
            _ if address.wrapping_sub(FLASH_BASE) < FLASH_BYTES => {
                Some((&*self.flash, address - FLASH_BASE))
            }
            _ if address.wrapping_sub(RAM_BASE) < RAM_BYTES => {
                Some((&*self.ram, address - RAM_BASE))
            }
            _ => None,
        }
    }

    fn system_memory(&self, address: u32, bytes: u32) -> u32 {
        (0..bytes).fold(0, |word, n| {
            let at = address + n;
            let byte = match at {
                UNIQUE_ID..=0x1fff_f7b7 => self.unique_id[(at - UNIQUE_ID) as usize],
                DENSITY => (FLASH_BYTES / 1024) as u8,
                _ if at == DENSITY + 2 => (RAM_BYTES / 1024) as u8,
                _ if at == DENSITY + 1 || at == DENSITY + 3 => 0,
                // Read protection off: 0xa5 and its complement.
                OPTION_BYTES => 0xa5,
                _ if at == OPTION_BYTES + 1 => 0x5a,
                _ => 0xff,
            };
            word | u32::from(byte) << (8 * n)
        })
    }
}

impl Bus for Soc {
    fn read(&mut self, address: u32, bytes: u32) -> Result<u32, BusFault> {
        let now = self.shared.now.load(Ordering::Relaxed);
        self.advance(now);
        let word = self.bus_read(address, bytes, now);
        self.publish();
        word
    }

    fn write(&mut self, address: u32, bytes: u32, value: u32) -> Result<(), BusFault> {
        let now = self.shared.now.load(Ordering::Relaxed);
        self.advance(now);
        let result = self.bus_write(address, bytes, value, now);
        self.publish();
        result
    }
}
