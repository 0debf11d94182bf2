//! The real firmware's USB device behind the USB/IP server, spoken to over loopback as a kernel would,
//! while the same chip gates light. Virtual time follows the machine's clock here.

#[path = "../../tests/common/usbip_host.rs"]
mod usbip_host;

mod common;

use std::net::TcpListener;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use stspp_hil_mcu::controller::McuController;
use stspp_hil_mcu::front::{Clock, SharedController, share};
use stspp_hil_mcu::soc::Variant;
use stspp_hil_sim::device::{Controller, Line, PinEdge};
use stspp_hil_sim::front::usb::UsbFunction;
use stspp_hil_sim::front::usbip::server::{Export, Server};
use stspp_protocol::event::TriggerEvent;
use stspp_protocol::fault::FaultReason;
use stspp_protocol::message::{Event, FromDevice, Reply, Request};
use stspp_protocol::reply::RequestError;
use stspp_protocol::request::{Arm, Hello, SetTiming, StartBurst};
use stspp_protocol::timing::ProjectionTiming;
use stspp_protocol::usb;
use stspp_protocol::version::PROTOCOL_VERSION;
use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN};
use usbip_host::Host;

const REPLIES: u32 = 1;
const EVENTS: u32 = 2;

/// Server, chip, and a rig that only collects edges.
struct Bench {
    port: u16,
    controller: SharedController,
    edges: Arc<Mutex<Vec<PinEdge>>>,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Bench {
    fn new() -> Option<Self> {
        let image = common::image(Variant::F350)?;
        let controller = McuController::start(Variant::F350, image).unwrap();
        let start = Instant::now();
        let booted_ns = controller.now_ns();
        let clock: Clock = Arc::new(move || booted_ns + start.elapsed().as_nanos() as u64);
        let (controller, port) = share(controller, clock.clone()).expect("it has USB");
        let function: Arc<Mutex<dyn UsbFunction>> = Arc::new(Mutex::new(port));
        let server = Server::new(vec![Export::new(function)]);
        let stop = server.stop_flag();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let serving = std::thread::spawn(move || server.listen(&listener, |_| {}).unwrap());
        let edges = Arc::new(Mutex::new(Vec::new()));
        let rig = {
            let (mut controller, edges, stop) = (controller.clone(), edges.clone(), stop.clone());
            std::thread::spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    controller.run_until(clock(), &mut edges.lock().unwrap());
                    std::thread::sleep(Duration::from_millis(5));
                }
            })
        };
        Some(Self { port, controller, edges, stop, threads: vec![serving, rig] })
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            thread.join().unwrap();
        }
    }
}

/// What a driver does: an IN transfer always waits on either pipe.
struct Driver {
    host: Host,
    waiting: [u32; 2],
    decoders: [FrameDecoder; 2],
    events: Vec<Event>,
    next_seq: u16,
}

impl Driver {
    /// Imports the device, enumerates and configures it.
    fn attach(port: u16) -> Option<Self> {
        let mut host = Host::connect(port);
        let record = host.import("1-1")?;
        assert_eq!(u16::from_be_bytes([record[300], record[301]]), usb::VENDOR_ID);
        assert_eq!(u16::from_be_bytes([record[302], record[303]]), usb::PRODUCT_ID);
        let (status, device) = host.control([0x80, 6, 0, 1, 0, 0, 64, 0], &[]);
        assert_eq!((status, device.len(), device[0], device[1]), (0, 18, 18, 1));
        let (status, header) = host.control([0x80, 6, 0, 2, 0, 0, 9, 0], &[]);
        assert_eq!((status, header.len()), (0, 9));
        let (status, configuration) =
            host.control([0x80, 6, 0, 2, 0, 0, header[2], header[3]], &[]);
        assert_eq!((status, configuration.len()), (0, usize::from(header[2])));
        // The address that Linux gives is its own affair; the configuration is the device's.
        assert_eq!(host.control([0, 5, 77, 0, 0, 0, 0, 0], &[]).0, 0);
        assert_eq!(host.control([0, 9, configuration[5], 0, 0, 0, 0, 0], &[]).0, 0);
        let (_, set) = host.control([0x80, 8, 0, 0, 0, 0, 1, 0], &[]);
        assert_eq!(set, [configuration[5]]);
        let waiting = [REPLIES, EVENTS].map(|endpoint| host.send(true, endpoint, 64, [0; 8], &[]));
        let decoders = [FrameDecoder::new(), FrameDecoder::new()];
        Some(Self { host, waiting, decoders, events: vec![], next_seq: 1 })
    }

    /// Takes one answer of the server; the reply that it held, if any.
    fn step(&mut self) -> Option<(u16, Result<Reply, RequestError>)> {
        let head = self.host.bytes(48);
        let word = |at: usize| u32::from_be_bytes(head[at..at + 4].try_into().unwrap());
        assert_eq!((word(0), word(20)), (3, 0), "a transfer failed");
        let Some(pipe) = self.waiting.iter().position(|w| *w == word(4)) else {
            return None; // An OUT is done.
        };
        let data = self.host.bytes(word(24) as usize);
        self.waiting[pipe] = self.host.send(true, [REPLIES, EVENTS][pipe], 64, [0; 8], &[]);
        let mut reply = None;
        let mut rest = &data[..];
        while let Some(frame) = self.decoders[pipe].next_frame(&mut rest) {
            match FromDevice::decode(&frame.unwrap()).unwrap() {
                FromDevice::Event { event, .. } => self.events.push(event),
                FromDevice::Reply { seq, reply: r } => reply = Some((seq, r)),
            }
        }
        reply
    }

    fn call(&mut self, request: &Request) -> Result<Reply, RequestError> {
        let seq = self.next_seq;
        self.next_seq += 1;
        let mut out = [0; MAX_FRAME_LEN];
        let frame = request.encode(seq, &mut out).unwrap();
        self.host.send(false, u32::from(usb::ENDPOINT_REQUESTS), frame.len(), [0; 8], frame);
        loop {
            if let Some((answered, reply)) = self.step() {
                assert_eq!(answered, seq);
                return reply;
            }
        }
    }

    fn wait_event(&mut self, wanted: impl Fn(&Event) -> bool) {
        while !self.events.iter().any(&wanted) {
            self.step();
        }
    }

    fn triggers(&self) -> Vec<TriggerEvent> {
        let trigger = |event: &Event| match event {
            Event::TriggerEvent(trigger) => Some(*trigger),
            _ => None,
        };
        self.events.iter().filter_map(trigger).collect()
    }
}

const HELLO: Request = Request::Hello(Hello { host: PROTOCOL_VERSION });

#[test]
fn the_firmware_is_enumerated_answers_and_gates_light() {
    let Some(bench) = Bench::new() else { return };
    let mut driver = Driver::attach(bench.port).expect("lent");
    assert!(matches!(driver.call(&HELLO), Ok(Reply::Hello(_))));
    let begin = Instant::now();
    for _ in 0..20 {
        driver.call(&Request::GetInfo(stspp_protocol::request::GetInfo)).unwrap();
    }
    println!("a call over USB/IP takes {:.2} ms", begin.elapsed().as_secs_f64() * 1e3 / 20.0);

    let timing = ProjectionTiming {
        frame_period_us: 5_000,
        exposure_us: 3_000,
        ..ProjectionTiming::default()
    };
    driver.call(&Request::SetTiming(SetTiming { timing })).unwrap();
    driver.call(&Request::Arm(Arm)).unwrap();
    // Straight after power-on the duty budgets are empty: the burst is admitted.
    driver.call(&Request::StartBurst(StartBurst { frames: 8 })).unwrap();
    while driver.triggers().len() < 8 {
        driver.step();
    }
    let triggers = driver.triggers();
    std::thread::sleep(Duration::from_millis(50));
    let edges = bench.edges.lock().unwrap().clone();
    for (number, trigger) in triggers.iter().enumerate() {
        assert_eq!(trigger.frame_sequence as usize, number);
        assert_eq!(usize::from(trigger.slot_index), number);
        assert!(trigger.usb_sof.is_some());
        let rise = edges
            .iter()
            .filter(|e| e.high && e.line == Line::CameraTrigger(0))
            .nth(number)
            .expect("the pin rose");
        let gate = Line::Projector(number as u8);
        let lit = |high| edges.iter().find(|e| e.line == gate && e.high == high).expect("an edge");
        assert!(lit(true).time_ns <= rise.time_ns && rise.time_ns < lit(false).time_ns);
        // The device's microseconds count from its start, the pins' nanoseconds from power-on: the
        // same distance for every frame.
        let first = edges.iter().find(|e| e.high && e.line == Line::CameraTrigger(0)).unwrap();
        let device_us = trigger.trigger_time_us - triggers[0].trigger_time_us;
        let pin_us = (rise.time_ns - first.time_ns) as f64 / 1e3;
        assert!((device_us as f64 - pin_us).abs() < 0.2, "{device_us} {pin_us}");
    }

    // Nobody asks for anything: time goes on, and the heartbeat runs out.
    driver.wait_event(
        |event| matches!(event, Event::FaultEvent(f) if f.record.reason == FaultReason::HeartbeatLost),
    );
    assert!(bench.controller.lock().high_lines().is_empty());
    common::assert_chip_modelled(bench.controller.lock().chip());
}

#[test]
fn waiting_transfers_are_given_up_refused_requests_stall_and_a_pulled_cable_ends_the_connection() {
    let Some(mut bench) = Bench::new() else { return };
    let mut driver = Driver::attach(bench.port).expect("lent");
    driver.call(&HELLO).unwrap();
    // Replies are wanted no more; what comes then is there for the next one who asks.
    let unlink = driver.host.unlink(driver.waiting[0]);
    loop {
        let (kind, answered, (status, data)) = driver.host.reply();
        if kind == 4 {
            assert_eq!((answered, status), (unlink, -104));
            break;
        }
        // An event may have been on its way.
        assert_eq!((answered, status), (driver.waiting[1], 0));
        assert!(!data.is_empty());
        driver.waiting[1] = driver.host.send(true, EVENTS, 64, [0; 8], &[]);
    }
    driver.waiting[0] = driver.host.send(true, REPLIES, 64, [0; 8], &[]);
    assert!(matches!(driver.call(&HELLO), Ok(Reply::Hello(_))));

    // A vendor request that the device does not know, an endpoint that it does not have.
    let refused = driver.host.send(true, 0, 4, [0xc0, 0x55, 0, 0, 0, 0, 4, 0], &[]);
    let answer = loop {
        let (_, answered, reply) = driver.host.reply();
        if answered == refused {
            break reply;
        }
    };
    assert_eq!(answer, (-32, vec![]));
    assert!(Driver::attach(bench.port).is_none(), "lent twice");

    // The cable is pulled: the connection ends, and there is nothing to import.
    bench.controller.set_link_connected(false);
    let mut byte = [0; 4096];
    while std::io::Read::read(&mut driver.host.0.stream, &mut byte).unwrap() > 0 {}
    assert!(Driver::attach(bench.port).is_none(), "unplugged");
    bench.controller.set_link_connected(true);
    let mut again = (0..50)
        .find_map(|_| {
            std::thread::sleep(Duration::from_millis(20));
            Driver::attach(bench.port)
        })
        .expect("plugged in again");
    assert!(matches!(again.call(&HELLO), Ok(Reply::Hello(_))));
}

#[test]
fn a_chip_without_usb_cannot_be_shared() {
    let Some(image) = common::image(Variant::F330) else { return };
    let controller = McuController::start(Variant::F330, image).unwrap();
    assert!(share(controller, Arc::new(|| 0)).is_none());
}
