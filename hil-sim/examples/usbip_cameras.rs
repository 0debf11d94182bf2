//! Two UVC cameras over USB/IP that show a test pattern: what the end-to-end test plugs into a Linux
//! kernel, and what any Linux desktop can attach with `usbip attach -r 127.0.0.1 -b 1-1`.
//!
//! `cargo run --release -p stspp-hil-sim --example usbip_cameras -- [PORT]`; port 0 takes a free one,
//! which the first line of the output names. Ends with its standard input.

use std::io::Read;
use std::net::TcpListener;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::Instant;
use stspp_hil_sim::front::usb::UsbFunction;
use stspp_hil_sim::front::usbip::server::{Export, Server};
use stspp_hil_sim::front::uvc::descriptors::{Description, PixelFormat};
use stspp_hil_sim::front::uvc::payload::CLOCK_HZ;
use stspp_hil_sim::front::uvc::{Frame, FrameSource, Settings, UvcCamera};

const WIDTH: u16 = 1280;
const HEIGHT: u16 = 1024;
const FRAMES_PER_SECOND: u64 = 30;

/// A ramp that moves by a column a frame; gain makes it steeper.
struct Ramp {
    start: Instant,
    frames: u64,
}

impl FrameSource for Ramp {
    fn poll(&mut self, settings: Settings) -> Option<Frame> {
        let due = self.start.elapsed().as_micros() as u64 * FRAMES_PER_SECOND / 1_000_000;
        if due <= self.frames {
            return None;
        }
        self.frames = due;
        let row: Vec<u8> = (0..u64::from(WIDTH))
            .map(|x| ((x + due) % 256 * u64::from(settings.gain_percent) / 100).min(255) as u8)
            .collect();
        let (exposure_ticks, sof) = self.clock();
        Some(Frame {
            pixels: row.repeat(usize::from(HEIGHT)),
            exposure_ticks,
            sof,
            is_damaged: false,
        })
    }

    fn clock(&self) -> (u32, u16) {
        let elapsed = self.start.elapsed();
        let ticks = elapsed.as_nanos() * u128::from(CLOCK_HZ) / 1_000_000_000;
        (ticks as u32, (elapsed.as_millis() % 2048) as u16)
    }
}

fn camera(product: &str) -> Export {
    let description = Description {
        vendor_id: 0x1209,
        product_id: 0x000a,
        product: product.into(),
        serial: "SIMULATED".into(),
        width: WIDTH,
        height: HEIGHT,
        format: PixelFormat::Grey,
        interval_100ns: (10_000_000 / FRAMES_PER_SECOND) as u32,
    };
    let source = Ramp { start: Instant::now(), frames: 0 };
    let function: Arc<Mutex<dyn UsbFunction>> =
        Arc::new(Mutex::new(UvcCamera::new(description, source)));
    Export::new(function)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let port: u16 = std::env::args().nth(1).unwrap_or_else(|| "3240".into()).parse()?;
    let server = Server::new(vec![camera("stspp left camera"), camera("stspp right camera")]);
    let stop = server.stop_flag();
    let listener = TcpListener::bind(("127.0.0.1", port))?;
    println!("{}", listener.local_addr()?.port());
    std::thread::spawn(move || {
        let _ = std::io::stdin().read_to_end(&mut Vec::new());
        stop.store(true, Ordering::Relaxed);
    });
    server.listen(&listener, |said| eprintln!("{said}"))?;
    Ok(())
}
