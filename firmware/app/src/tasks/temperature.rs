//! The projectors' temperature from the thermistor; the chip's own into the log.

use crate::{board, shared};
use embassy_gd32f3x0::adc::{Adc, Input};
use embassy_gd32f3x0::calc::analog;
use embassy_time::{Duration, Ticker};

/// Between two readings. A projector heats its board by well under a degree in that time.
const INTERVAL: Duration = Duration::from_millis(50);
/// Readings between two entries in the log.
const LOG_EVERY: u32 = 200;

/// What a broken sensor reads as: beyond what the logic takes for a temperature.
const OPEN_DC: i16 = -2_731;
const SHORTED_DC: i16 = i16::MAX;

/// Reads for ever.
#[embassy_executor::task]
pub(crate) async fn run(mut adc: Adc<'static>, ntc: Input) {
    let mut ticker = Ticker::every(INTERVAL);
    let mut round = 0u32;
    loop {
        let reading = adc.read(ntc).await;
        let temperature_dc = match analog::thermistor_ohm(reading, board::NTC_PULL_UP_OHM) {
            Some(ohm) => i16::try_from(analog::thermistor_dc(ohm)).unwrap_or(SHORTED_DC),
            None if reading > 2_048 => OPEN_DC,
            None => SHORTED_DC,
        };
        shared::with_controller(|c, now_us| c.on_temperature(now_us, temperature_dc));
        if round.is_multiple_of(LOG_EVERY) {
            let supply_mv = analog::supply_mv(adc.read(Input::VREFINT).await).unwrap_or(0);
            let die_dc = analog::die_temperature_dc(adc.read(Input::TEMPERATURE).await, supply_mv);
            defmt::info!(
                "projectors {=i16} dC, chip {=i32} dC, supply {=u32} mV",
                temperature_dc,
                die_dc,
                supply_mv
            );
        }
        round = round.wrapping_add(1);
        ticker.next().await;
    }
}
