//! The USB/IP server with a camera behind it, spoken to over loopback as a kernel would.

#[path = "common/usbip_host.rs"]
mod usbip_host;

use std::io::Write;
use std::net::TcpListener;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use stspp_hil_sim::front::usb::UsbFunction;
use stspp_hil_sim::front::usbip::server::{Export, Server};
use stspp_hil_sim::front::uvc::descriptors::{Description, PixelFormat};
use stspp_hil_sim::front::uvc::{Frame, FrameSource, Settings, UvcCamera};
use usbip_host::Host;

const WIDTH: u16 = 100;
const HEIGHT: u16 = 70;

/// Gives one frame per poll while `left` lasts; each pixel is the gain plus its index.
struct Counting {
    left: Arc<Mutex<u32>>,
}

impl FrameSource for Counting {
    fn poll(&mut self, settings: Settings) -> Option<Frame> {
        let mut left = self.left.lock().unwrap();
        *left = left.checked_sub(1)?;
        let first = settings.gain_percent as usize;
        let pixels = (0..usize::from(WIDTH) * usize::from(HEIGHT)).map(|i| (first + i) as u8);
        Some(Frame { pixels: pixels.collect(), exposure_ticks: 48_000, sof: 5, is_damaged: false })
    }

    fn clock(&self) -> (u32, u16) {
        (96_000, 7)
    }
}

struct Bench {
    port: u16,
    frames: Arc<Mutex<u32>>,
    stop: Arc<std::sync::atomic::AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Bench {
    fn new() -> Self {
        let frames = Arc::new(Mutex::new(0));
        let description = Description {
            vendor_id: 0x1209,
            product_id: 0x5753,
            product: "left camera".into(),
            serial: "S1".into(),
            width: WIDTH,
            height: HEIGHT,
            format: PixelFormat::Grey,
            interval_100ns: 333_333,
        };
        let camera = UvcCamera::new(description, Counting { left: frames.clone() });
        let function: Arc<Mutex<dyn UsbFunction>> = Arc::new(Mutex::new(camera));
        let server = Server::new(vec![Export::new(function)]);
        let stop = server.stop_flag();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let thread = std::thread::spawn(move || server.listen(&listener, |_| {}).unwrap());
        Self { port, frames, stop, thread: Some(thread) }
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

const SET_CONFIGURATION: [u8; 8] = [0, 9, 1, 0, 0, 0, 0, 0];
const COMMIT: [u8; 8] = [0x21, 1, 0, 2, 1, 0, 34, 0];

#[test]
fn devices_are_listed_and_lent_once() {
    let bench = Bench::new();
    let mut host = Host::connect(bench.port);
    host.0.stream.write_all(&[1, 0x11, 0x80, 0x05, 0, 0, 0, 0]).unwrap();
    let listing = host.bytes(12);
    assert_eq!(listing[8..], [0, 0, 0, 1]);
    let record = host.bytes(312 + 8);
    assert_eq!(&record[256..260], b"1-1\0");
    assert_eq!(record[300..304], [0x12, 0x09, 0x57, 0x53]);
    assert_eq!(record[312..315], [0x0e, 1, 0]);

    let mut first = Host::connect(bench.port);
    assert!(first.import("1-1").is_some());
    assert!(Host::connect(bench.port).import("1-1").is_none(), "lent twice");
    assert!(Host::connect(bench.port).import("1-2").is_none(), "there is no second device");
    drop(first);
    for _ in 0..100 {
        if Host::connect(bench.port).import("1-1").is_some() {
            return;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    panic!("not given back after its host had gone");
}

#[test]
fn a_frame_arrives_whole_and_settings_show_in_it() {
    let bench = Bench::new();
    let mut host = Host::connect(bench.port);
    host.import("1-1").unwrap();
    let (status, device) = host.control([0x80, 6, 0, 1, 0, 0, 18, 0], &[]);
    assert_eq!((status, device.len(), device[8], device[10]), (0, 18, 0x09, 0x53));
    assert_eq!(host.control(SET_CONFIGURATION, &[]).0, 0);
    // Gain 3.00: processing unit 2, selector 4.
    assert_eq!(host.control([0x21, 1, 0, 4, 0, 2, 2, 0], &[44, 1]).0, 0);
    assert_eq!(host.control([0xa1, 0x81, 0, 4, 0, 2, 2, 0], &[]).1, [44, 1]);
    // Out of range: refused, the setting stays.
    assert_eq!(host.control([0x21, 1, 0, 4, 0, 2, 2, 0], &[0xff, 0xff]).0, -32);
    assert_eq!(host.control([0xa1, 0x81, 0, 4, 0, 2, 2, 0], &[]).1, [44, 1]);
    let (_, probe) = host.control([0xa1, 0x81, 0, 1, 1, 0, 34, 0], &[]);
    let payload = u32::from_le_bytes(probe[22..26].try_into().unwrap()) as usize;
    assert_eq!(payload, 12 + usize::from(WIDTH) * usize::from(HEIGHT));
    assert_eq!(host.control(COMMIT, &probe).0, 0);

    // Buffers as uvcvideo makes them: the payload ends with the first short one.
    const BUFFER: usize = 1024;
    let count = payload / BUFFER + 1;
    for _ in 0..count {
        host.send(true, 1, BUFFER, [0; 8], &[]);
    }
    *bench.frames.lock().unwrap() = 1;
    let mut received = Vec::new();
    for i in 0..count {
        let (_, _, (status, data)) = host.reply();
        assert_eq!(status, 0);
        assert_eq!(data.len() < BUFFER, i == count - 1);
        received.extend(data);
    }
    assert_eq!(received[0], 12);
    assert_eq!(received[2..6], 48_000u32.to_le_bytes());
    assert_eq!(received[10..12], [7, 0]);
    assert_eq!(received.len(), payload);
    assert!(received[12..].iter().enumerate().all(|(i, p)| *p == (300 + i) as u8));
}

#[test]
fn a_waiting_transfer_can_be_given_up_and_blocks_nothing() {
    let bench = Bench::new();
    let mut host = Host::connect(bench.port);
    host.import("1-1").unwrap();
    host.control(SET_CONFIGURATION, &[]);
    host.control(COMMIT, &[0; 34]);
    let waiting = host.send(true, 1, 512, [0; 8], &[]);
    // Nothing to send yet, but control transfers go on.
    assert_eq!(host.control([0x80, 8, 0, 0, 0, 0, 1, 0], &[]), (0, vec![1]));
    let unlink = host.unlink(waiting);
    assert_eq!(host.reply(), (4, unlink, (-104, vec![])));
    // Linux may give a transfer up before it asks for it: then it is never answered.
    let early = host.unlink(unlink + 2);
    assert_eq!(host.reply(), (4, early, (-104, vec![])));
    assert_eq!(host.send(true, 1, 512, [0; 8], &[]), unlink + 2);
    *bench.frames.lock().unwrap() = 1;
    assert_eq!(host.control([0x80, 8, 0, 0, 0, 0, 1, 0], &[]), (0, vec![1]));
    // An endpoint that is not there stalls.
    let stalled = host.send(true, 3, 64, [0; 8], &[]);
    assert_eq!(host.reply(), (3, stalled, (-32, vec![])));
}

/// Gives the same full-size picture for ever, with its number in the first pixels.
struct Endless {
    pixels: Vec<u8>,
    number: u32,
}

impl FrameSource for Endless {
    fn poll(&mut self, _: Settings) -> Option<Frame> {
        self.number += 1;
        self.pixels[..4].copy_from_slice(&self.number.to_le_bytes());
        Some(Frame {
            pixels: self.pixels.clone(),
            exposure_ticks: self.number,
            sof: 0,
            is_damaged: false,
        })
    }

    fn clock(&self) -> (u32, u16) {
        (self.number, 0)
    }
}

/// Fetches `frames` pictures as `uvcvideo` does, five transfers of 16 KiB under way.
fn fetch(port: u16, bus_id: &str, frames: u32, expected: &[u8]) {
    const BUFFER: usize = 16 * 1024;
    let mut host = Host::connect(port);
    host.import(bus_id).unwrap();
    assert_eq!(host.control(SET_CONFIGURATION, &[]).0, 0);
    assert_eq!(host.control(COMMIT, &[0; 34]).0, 0);
    for _ in 0..5 {
        host.send(true, 1, BUFFER, [0; 8], &[]);
    }
    let mut payload: Vec<u8> = Vec::with_capacity(expected.len() + 12);
    let mut number = 0;
    while number < frames {
        let (_, _, (status, data)) = host.reply();
        assert_eq!(status, 0);
        host.send(true, 1, BUFFER, [0; 8], &[]);
        payload.extend(&data);
        if data.len() < BUFFER {
            number += 1;
            assert_eq!(payload[12..16], number.to_le_bytes());
            assert!(payload[16..] == expected[4..], "picture {number} of {bus_id}");
            payload.clear();
        }
    }
}

#[test]
fn two_full_size_cameras_take_a_small_part_of_a_core() {
    const FRAMES: u32 = 60;
    let pixels: Vec<u8> = (0..1280 * 1024u32).map(|k| (k % 251) as u8).collect();
    let camera = |product: &str| {
        let description = Description {
            vendor_id: 0x1209,
            product_id: 0x5753,
            product: product.into(),
            serial: "S1".into(),
            width: 1280,
            height: 1024,
            format: PixelFormat::Grey,
            interval_100ns: 333_333,
        };
        let source = Endless { pixels: pixels.clone(), number: 0 };
        let function: Arc<Mutex<dyn UsbFunction>> =
            Arc::new(Mutex::new(UvcCamera::new(description, source)));
        Export::new(function)
    };
    let server = Server::new(vec![camera("left"), camera("right")]);
    let stop = server.stop_flag();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let serving = std::thread::spawn(move || server.listen(&listener, |_| {}).unwrap());
    let cpu_s = || {
        let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
        let fields = stat.rsplit_once(')').unwrap_or_default().1.split_whitespace();
        fields.skip(11).take(2).map(|f| f.parse::<f64>().unwrap() / 100.0).sum::<f64>()
    };
    let (before_s, begun) = (cpu_s(), std::time::Instant::now());
    std::thread::scope(|scope| {
        for bus_id in ["1-1", "1-2"] {
            let pixels = &pixels;
            scope.spawn(move || fetch(port, bus_id, FRAMES, pixels));
        }
    });
    let (used_s, wall_s) = (cpu_s() - before_s, begun.elapsed().as_secs_f64());
    stop.store(true, Ordering::Relaxed);
    serving.join().unwrap();
    // CPU time, because it does not depend on what else the machine does. Host and server together.
    let per_second = used_s / f64::from(FRAMES) * 30.0;
    println!(
        "{FRAMES} frames of each camera in {wall_s:.2} s ({:.0} MB/s); at 30 Hz {:.0} % of a core",
        2.0 * f64::from(FRAMES) * pixels.len() as f64 * 1e-6 / wall_s,
        100.0 * per_second
    );
    assert!(per_second < 0.8, "{per_second:.2} cores for 30 Hz");
}

#[test]
fn noise_instead_of_usbip_ends_the_connection_only() {
    let bench = Bench::new();
    let mut state = 1u32;
    for _ in 0..20 {
        let mut host = Host::connect(bench.port);
        let noise: Vec<u8> = (0..200)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            })
            .collect();
        let _ = host.0.stream.write_all(&noise);
    }
    assert!(Host::connect(bench.port).import("1-1").is_some());
}
