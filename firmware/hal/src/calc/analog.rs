//! Analog readings as physical values (data sheet, "ADC characteristics", "Temperature sensor
//! characteristics"; user manual, "ADC": "Temperature sensor and internal reference voltage").

/// Internal reference in millivolts, typical (data sheet: 1.16 to 1.24 V).
pub const VREFINT_MV: u32 = 1_200;
/// Sensor voltage at 25 degrees in microvolts, typical.
const V25_UV: i32 = 1_430_000;
/// Sensor slope in microvolts per degree, typical (falls with temperature).
const SLOPE_UV_PER_C: i32 = 4_300;

/// Supply in millivolts from a 12-bit reading of the internal reference; `None` for a reading that
/// no working converter gives (0).
pub const fn supply_mv(vrefint_reading: u16) -> Option<u32> {
    if vrefint_reading == 0 { None } else { Some(VREFINT_MV * 4095 / vrefint_reading as u32) }
}

/// Die temperature in tenths of a degree from a 12-bit reading and the supply.
pub const fn die_temperature_dc(reading: u16, supply_mv: u32) -> i32 {
    let uv = (reading as i64 * supply_mv as i64 * 1000 / 4095) as i32;
    250 + (V25_UV - uv) * 10 / SLOPE_UV_PER_C
}

/// Resistance of a thermistor to ground under a pull-up to the same supply as the converter's
/// reference, in ohms. `None` where it is open (reading near full scale) or shorted (near 0): a
/// broken sensor must never look like a temperature.
pub const fn thermistor_ohm(reading: u16, pull_up_ohm: u32) -> Option<u32> {
    if reading < 40 || reading > 4055 {
        return None;
    }
    Some((pull_up_ohm as u64 * reading as u64 / (4095 - reading as u64)) as u32)
}

/// Resistances in ohms of a thermistor with 10 kOhm at 25 degrees and B = 3950 K, from -40 degrees
/// in steps of 5: `10 kOhm * exp(B * (1 / T - 1 / 298.15 K))`.
const THERMISTOR_OHM: [u32; 34] = [
    401860, 281577, 200204, 144317, 105385, 77898, 58246, 44026, 33621, 25925, 20175, 15837, 12535,
    10000, 8037, 6506, 5301, 4348, 3588, 2978, 2486, 2086, 1760, 1492, 1270, 1087, 934, 805, 698,
    606, 529, 463, 407, 359,
];
const THERMISTOR_FIRST_DC: i32 = -400;
const THERMISTOR_STEP_DC: i32 = 50;

/// Temperature in tenths of a degree of that thermistor, linear between the table's steps (0.2
/// degrees off at most between 0 and 100); beyond the table, its end.
pub fn thermistor_dc(ohm: u32) -> i32 {
    // Falling resistances: the first that is at or below `ohm` is the upper end of the step.
    let upper = THERMISTOR_OHM.partition_point(|&step| step > ohm);
    if upper == 0 {
        return THERMISTOR_FIRST_DC;
    }
    let Some(&above) = THERMISTOR_OHM.get(upper) else {
        return THERMISTOR_FIRST_DC + THERMISTOR_STEP_DC * (THERMISTOR_OHM.len() as i32 - 1);
    };
    let below = THERMISTOR_OHM[upper - 1];
    let part = (below - ohm) as i32 * THERMISTOR_STEP_DC / (below - above) as i32;
    THERMISTOR_FIRST_DC + THERMISTOR_STEP_DC * (upper as i32 - 1) + part
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thermistor_follows_its_law() {
        let ohm = |celsius: f64| 1e4 * (3950.0 * (1.0 / (celsius + 273.15) - 1.0 / 298.15)).exp();
        for tenths in -400..=1250 {
            let celsius = f64::from(tenths) / 10.0;
            let made = f64::from(thermistor_dc(ohm(celsius).round() as u32)) / 10.0;
            let tolerance = if (0..=1000).contains(&tenths) { 0.31 } else { 0.6 };
            assert!((made - celsius).abs() < tolerance, "{celsius}: {made}");
        }
        assert_eq!(thermistor_dc(10_000), 250);
        assert_eq!(thermistor_dc(1_000_000), -400);
        assert_eq!(thermistor_dc(1), 1250);
    }

    #[test]
    fn supply_from_the_reference() {
        assert_eq!(supply_mv(1489), Some(3300));
        assert_eq!(supply_mv(0), None);
    }

    #[test]
    fn die_temperature_at_the_data_sheets_points() {
        let reading = |volts: f64| (volts / 3.3 * 4095.0).round() as u16;
        assert!((die_temperature_dc(reading(1.43), 3300) - 250).abs() <= 2);
        assert!((die_temperature_dc(reading(1.43 - 0.0043 * 60.0), 3300) - 850).abs() <= 2);
    }

    #[test]
    fn a_broken_thermistor_is_no_temperature() {
        assert_eq!(thermistor_ohm(4095, 10_000), None);
        assert_eq!(thermistor_ohm(0, 10_000), None);
        assert_eq!(thermistor_ohm(2047, 10_000), Some(9_995));
    }
}
