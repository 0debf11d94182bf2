//! How many slots the in-process device runs per second of CPU: `cargo run --release -p stspp-hil-sim
//! --example device_speed`.

use std::time::Instant;

use stspp_hil_sim::device::Controller;
use stspp_hil_sim::device::in_process::InProcess;
use stspp_protocol::message::encode_request;
use stspp_protocol::request::{Arm, Heartbeat, Hello, SetTiming, StartStream};
use stspp_protocol::timing::ProjectionTiming;
use stspp_protocol::version::PROTOCOL_VERSION;
use stspp_protocol::wire::{EncodeError, MAX_FRAME_LEN};

fn main() -> Result<(), EncodeError> {
    let mut device = InProcess::default();
    let mut out = [0; MAX_FRAME_LEN];
    let timing = ProjectionTiming {
        frame_period_us: 1_000,
        exposure_us: 900,
        trigger_delay_us: 20,
        gate_lead_us: 10,
        gate_lag_us: 10,
        ..ProjectionTiming::default()
    };
    device.host_write(encode_request(1, &Hello { host: PROTOCOL_VERSION }, &mut out)?);
    device.host_write(encode_request(2, &SetTiming { timing }, &mut out)?);
    device.host_write(encode_request(3, &Arm, &mut out)?);
    device.host_write(encode_request(4, &StartStream, &mut out)?);
    let heartbeat = encode_request(5, &Heartbeat, &mut out)?;

    let (mut edges, mut bytes) = (Vec::new(), Vec::new());
    let (mut edge_count, mut byte_count) = (0, 0);
    let began = Instant::now();
    let simulated_s = 1_000;
    for quarter in 1..=4 * simulated_s {
        device.host_write(heartbeat);
        device.run_until(quarter * 250_000_000, &mut edges);
        device.host_read(&mut bytes);
        edge_count += edges.len();
        byte_count += bytes.len();
        edges.clear();
        bytes.clear();
    }
    let took_s = began.elapsed().as_secs_f64();
    println!(
        "{simulated_s} s at 1 kHz in {took_s:.2} s: {:.0} slots/s, {edge_count} edges, {byte_count} bytes",
        1_000.0 * simulated_s as f64 / took_s
    );
    Ok(())
}
