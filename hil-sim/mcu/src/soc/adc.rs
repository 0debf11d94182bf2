//! ADC (user manual chapter 11): calibration, software-triggered sequences with conversion times,
//! DMA requests. What a channel sees is a voltage that the world sets.

use super::peripheral::{Cx, DmaSource, NEVER, Peripheral, Signal};

/// Supply and reference voltage.
pub const VDDA_V: f32 = 3.3;
/// Internal reference (datasheet: 1.2 V typical).
pub const VREFINT_V: f32 = 1.2;
/// Temperature sensor at 25 degrees and its slope (datasheet: 1.45 V, -4.1 mV per degree).
const SENSOR_25_V: f32 = 1.45;
const SENSOR_SLOPE_V: f32 = -0.0041;

const EOC: u32 = 1 << 1;
const STRC: u32 = 1 << 4;
const ADCON: u32 = 1;
const CTN: u32 = 1 << 1;
const CLB: u32 = 1 << 2;
const RSTCLB: u32 = 1 << 3;

/// Sample times in half cycles of the ADC clock (user manual SAMPT).
const SAMPLE_HALF_CYCLES: [u64; 8] = [3, 15, 27, 57, 83, 111, 143, 479];

/// The converter and the voltages at its inputs.
#[derive(Debug)]
pub struct Adc {
    stat: u32,
    ctl: [u32; 2],
    sampt: [u32; 2],
    rsq: [u32; 3],
    rdata: u32,
    watchdog: [u32; 2],
    volts: [f32; 19],
    die_temperature_c: f32,
    /// Position in the sequence and the end of its conversion.
    converting: Option<(u32, u64)>,
    calibrating_until: u64,
}

impl Adc {
    /// The converter after reset.
    #[must_use]
    pub fn new() -> Self {
        Self {
            stat: 0,
            ctl: [0; 2],
            sampt: [0; 2],
            rsq: [0; 3],
            rdata: 0,
            watchdog: [0xfff, 0],
            volts: [0.0; 19],
            die_temperature_c: 30.0,
            converting: None,
            calibrating_until: 0,
        }
    }

    /// Takes over the inputs from the model before a reset.
    #[must_use]
    pub fn wired_as(mut self, before: &Adc) -> Self {
        self.volts = before.volts;
        self.die_temperature_c = before.die_temperature_c;
        self
    }

    /// Sets the voltage at channel `channel` (0..=15).
    pub fn set_volts(&mut self, channel: u8, volts: f32) {
        self.volts[usize::from(channel)] = volts;
    }

    /// Sets the temperature of the die.
    pub fn set_die_temperature_c(&mut self, temperature_c: f32) {
        self.die_temperature_c = temperature_c;
    }

    fn input_volts(&self, channel: u32) -> f32 {
        let internal = self.ctl[1] >> 23 & 1 != 0;
        match channel {
            16 if internal => SENSOR_25_V + SENSOR_SLOPE_V * (self.die_temperature_c - 25.0),
            17 if internal => VREFINT_V,
            16..=18 => 0.0,
            n => self.volts[n as usize & 0xf],
        }
    }

    fn channel_at(&self, position: u32) -> u32 {
        let word = match position {
            0..=5 => self.rsq[2],
            6..=11 => self.rsq[1],
            _ => self.rsq[0],
        };
        word >> (5 * (position % 6)) & 0x1f
    }

    fn sequence_length(&self) -> u32 {
        (self.rsq[0] >> 20 & 0xf) + 1
    }

    fn conversion_cycles(&self, channel: u32, cx: &Cx<'_>) -> u64 {
        let field = if channel < 10 {
            self.sampt[1] >> (3 * channel) & 7
        } else {
            self.sampt[0] >> (3 * (channel - 10)) & 7
        };
        // 12.5 cycles of conversion after the sampling.
        let half_cycles = SAMPLE_HALF_CYCLES[field as usize] + 25;
        (half_cycles * u64::from(cx.clocks.hclk_hz))
            .div_ceil(2 * u64::from(cx.clocks.adc_hz.max(1)))
    }

    fn start(&mut self, cx: &mut Cx<'_>) {
        if self.ctl[1] & ADCON != 0 && self.converting.is_none() {
            self.stat |= STRC;
            self.convert_at(0, cx);
        }
    }

    fn convert_at(&mut self, position: u32, cx: &Cx<'_>) {
        let channel = self.channel_at(position);
        self.converting = Some((position, cx.now + self.conversion_cycles(channel, cx)));
    }

    fn raise(&self, cx: &mut Cx<'_>) {
        cx.out.push(Signal::Irq(12, self.stat & EOC != 0 && self.ctl[0] >> 5 & 1 != 0));
    }
}

impl Default for Adc {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Adc {
    fn read(&mut self, offset: u32, cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 => self.stat,
            0x04 => self.ctl[0],
            0x08 => {
                let calibrating = if cx.now < self.calibrating_until { CLB } else { 0 };
                self.ctl[1] | calibrating
            }
            0x0c | 0x10 => self.sampt[(offset as usize - 0x0c) / 4],
            0x24 | 0x28 => self.watchdog[(offset as usize - 0x24) / 4],
            0x2c..=0x34 => self.rsq[(offset as usize - 0x2c) / 4],
            0x4c => {
                self.stat &= !EOC;
                self.raise(cx);
                cx.out.push(Signal::DmaLevel(DmaSource::Adc, false));
                self.rdata
            }
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        match offset {
            0x00 => {
                self.stat &= value;
                self.raise(cx);
            }
            0x04 => {
                self.ctl[0] = value;
                self.raise(cx);
            }
            0x08 => {
                let was_on = self.ctl[1] & ADCON != 0;
                // Calibration takes 83 ADC clocks (user manual 11.4.1); its reset is immediate.
                if value & CLB != 0 {
                    let cycles =
                        83 * u64::from(cx.clocks.hclk_hz) / u64::from(cx.clocks.adc_hz.max(1));
                    self.calibrating_until = cx.now + cycles;
                }
                self.ctl[1] = value & !(CLB | RSTCLB | 1 << 22);
                if value & ADCON == 0 {
                    self.converting = None;
                }
                // Software start: SWRCST with the external trigger "software" (ETSRC = 7, ETERC), or
                // ADCON written while on with nothing else changed.
                if value >> 22 & 1 != 0 && value >> 20 & 1 != 0 && value >> 17 & 7 == 7 && was_on {
                    self.start(cx);
                }
            }
            0x0c | 0x10 => self.sampt[(offset as usize - 0x0c) / 4] = value,
            0x24 | 0x28 => self.watchdog[(offset as usize - 0x24) / 4] = value & 0xfff,
            0x2c..=0x34 => self.rsq[(offset as usize - 0x2c) / 4] = value,
            _ => {}
        }
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            0x00 => Some(0x1f),
            // End-of-conversion interrupt and scan mode.
            0x04 => Some(0x0120),
            // Power, continuous, calibration, DMA, software trigger, internal channels.
            0x08 => Some(0x00de_010f),
            0x0c | 0x10 => Some(0x3fff_ffff),
            0x2c..=0x34 => Some(0x3fff_ffff),
            0x4c => Some(0),
            _ => None,
        }
    }

    fn next_event(&self) -> u64 {
        self.converting.map_or(NEVER, |(_, at)| at)
    }

    fn event(&mut self, cx: &mut Cx<'_>) {
        let Some((position, _)) = self.converting.take() else { return };
        let volts = self.input_volts(self.channel_at(position));
        let code = (volts / VDDA_V * 4096.0).round().clamp(0.0, 4095.0) as u32;
        self.rdata = if self.ctl[1] >> 11 & 1 != 0 { code << 4 } else { code };
        self.stat |= EOC;
        if self.ctl[1] >> 8 & 1 != 0 {
            cx.out.push(Signal::DmaLevel(DmaSource::Adc, true));
        }
        let scan = self.ctl[0] >> 8 & 1 != 0;
        if scan && position + 1 < self.sequence_length() {
            self.convert_at(position + 1, cx);
        } else if self.ctl[1] & CTN != 0 {
            self.convert_at(0, cx);
        }
        self.raise(cx);
    }
}
