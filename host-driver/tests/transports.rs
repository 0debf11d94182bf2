//! One set of protocol tests for every control link: the simulator's, a serial port (a pseudo-terminal
//! with the in-process controller behind it), USB endpoints (a simulated device's, called directly),
//! and, in the machine of `cargo xtask e2e`, real ones.
#![cfg(all(feature = "sim", feature = "usb", target_os = "linux"))]

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use stspp::clock::{Clock, MonotonicClock, VirtualClock};
use stspp::sim::{SimOptions, SimSensor};
use stspp::transport::serial::{self, SerialTransport};
use stspp::transport::usb::PolledUsb;
use stspp::transport::usb::pipes::{PipeError, Pipes};
use stspp::transport::{Link, Transport, TransportError};
use stspp::{Error, ProjectionTiming, Slot};
use stspp_hil_sim::device::Controller;
use stspp_hil_sim::device::in_process::InProcess;
use stspp_hil_sim::front::bench::Bench;
use stspp_hil_sim::front::control::ControlFunction;
use stspp_hil_sim::front::usb::{Answer, Setup, UsbFunction};
use stspp_hil_sim::rig::Rig;
use stspp_protocol::message::Event;
use stspp_protocol::reply::{DeviceState, RequestError};
use stspp_protocol::request::{
    Arm, Disarm, GetInfo, GetStatus, GetTiming, Heartbeat, LoadDefaults, SetTiming, StartBurst,
    StartStream, StopStream,
};
use stspp_protocol::version::PROTOCOL_VERSION;

/// What every link has to do.
fn protocol_suite(link: &mut Link) {
    let info = link.hello().unwrap();
    assert!(info.protocol.is_compatible_with(PROTOCOL_VERSION));
    assert_eq!(link.call(&GetInfo).unwrap().serial, info.serial);

    // The longest request there is goes through whole, and comes back.
    let mut timing = ProjectionTiming { exposure_us: 8_000, ..ProjectionTiming::default() };
    timing.slots = (0..usize::from(info.limits.max_slots))
        .map(|k| Slot { projector_mask: 1 << (k % 10), floodlight: false })
        .collect();
    let accepted = link.call(&SetTiming { timing: timing.clone() }).unwrap();
    let active = link.call(&GetTiming).unwrap();
    assert_eq!((active.timing, active.timing_generation), (timing, accepted.timing_generation));

    // What is refused is refused with its reason, and changes nothing.
    let bad = ProjectionTiming { exposure_us: 60_000, ..ProjectionTiming::default() };
    let refused = link.call(&SetTiming { timing: bad }).unwrap_err();
    let Error::Refused { source: RequestError::Timing(_), .. } = refused else {
        panic!("{refused}")
    };
    let unarmed = link.call(&StartStream).unwrap_err();
    assert!(matches!(unarmed, Error::Refused { .. }), "{unarmed}");

    // Many requests in a row, each answered by its own reply.
    for _ in 0..50 {
        link.call(&Heartbeat).unwrap();
    }

    // Light, and an event for each trigger, in order and without a gap.
    link.call(&LoadDefaults).unwrap();
    link.call(&Arm).unwrap();
    let count = 12u32;
    let started = link.call(&StartBurst { frames: count as u16 }).unwrap();
    let mut triggers = Vec::new();
    for _ in 0..2_000 {
        link.pump(Duration::from_millis(5)).unwrap();
        while let Some(timed) = link.next_event() {
            if let Event::TriggerEvent(trigger) = timed.event {
                triggers.push(trigger);
            }
        }
        if triggers.len() == count as usize {
            break;
        }
    }
    let sequences: Vec<u32> = triggers.iter().map(|t| t.frame_sequence).collect();
    let first = started.first_frame_sequence;
    assert_eq!(sequences, (first..first + count).collect::<Vec<_>>());
    let slots: Vec<u8> = triggers.iter().map(|t| t.slot_index).collect();
    assert_eq!(slots, (0..count).map(|k| (k % 10) as u8).collect::<Vec<_>>());

    link.call(&StopStream).unwrap();
    link.call(&Disarm).unwrap();
    let status = link.call(&GetStatus).unwrap();
    assert_eq!((status.state, status.latched.is_empty()), (DeviceState::Idle, true));
    let stats = link.stats();
    assert_eq!((stats.frames_rejected, stats.frames_unreadable, stats.events_lost), (0, 0, 0));
}

#[test]
fn sim() {
    let options = SimOptions::parse(Some("plane"), &[("scale".into(), "16".into())]).unwrap();
    let sim = SimSensor::new(&options).unwrap();
    let clock = Arc::clone(&sim.clock);
    protocol_suite(&mut Link::new(Box::new(sim.link), clock));
}

/// A pseudo-terminal whose other end a thread serves.
struct Port {
    path: PathBuf,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    _open: Option<serial2::SerialPort>,
}

impl Port {
    fn new(mut serve: impl FnMut(&[u8]) -> Vec<u8> + Send + 'static) -> Self {
        use std::os::fd::AsRawFd;
        let (mut ours, theirs) = serial2::SerialPort::pair().unwrap();
        let path = std::fs::read_link(format!("/proc/self/fd/{}", theirs.as_raw_fd())).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        ours.set_read_timeout(Duration::from_millis(1)).unwrap();
        let thread = std::thread::spawn(move || {
            let mut buffer = [0; 1024];
            while !stopped.load(Ordering::Acquire) {
                let read = ours.read(&mut buffer).unwrap_or(0);
                let said = serve(&buffer[..read]);
                if !said.is_empty() && ours.write_all(&said).is_err() {
                    break;
                }
            }
        });
        Self { path, stop, thread: Some(thread), _open: Some(theirs) }
    }

    /// With the in-process controller of the serial board, in the wall's time.
    fn with_controller() -> Self {
        let mut controller = InProcess::default();
        let start = Instant::now();
        let mut edges = Vec::new();
        Self::new(move |heard| {
            controller.host_write(heard);
            controller.run_until(start.elapsed().as_nanos() as u64, &mut edges);
            edges.clear();
            let mut said = Vec::new();
            controller.host_read(&mut said);
            said
        })
    }

    fn link(&self) -> Link {
        let transport = SerialTransport::open(&self.path).unwrap();
        Link::new(Box::new(transport), Arc::new(MonotonicClock::new()))
    }

    fn unplug(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.thread.take().unwrap().join().unwrap();
    }
}

impl Drop for Port {
    fn drop(&mut self) {
        if self.thread.is_some() {
            self.unplug();
        }
    }
}

#[test]
fn serial_port() {
    let port = Port::with_controller();
    protocol_suite(&mut port.link());
    let info = serial::probe(&port.path).unwrap();
    assert_eq!(info.serial.to_string().len(), 24);
}

#[test]
fn a_serial_port_has_one_owner() {
    let port = Port::with_controller();
    let first = SerialTransport::open(&port.path).unwrap();
    let second = SerialTransport::open(&port.path).err().unwrap();
    assert!(matches!(second, TransportError::Busy { .. }), "{second}");
    drop(first);
    SerialTransport::open(&port.path).unwrap();
}

#[test]
fn something_else_at_the_port_is_named_in_less_than_a_second() {
    let begun = Instant::now();
    // A terminal server that greets, a plug that echoes, and silence.
    let chatter = Port::new(|heard| if heard.is_empty() { vec![] } else { b"login: ".to_vec() });
    let error = serial::probe(&chatter.path).unwrap_err();
    assert!(matches!(error, Error::Transport(TransportError::NotASensor { .. })), "{error}");
    let echo = Port::new(<[u8]>::to_vec);
    let error = serial::probe(&echo.path).unwrap_err();
    assert!(matches!(error, Error::Transport(TransportError::NotASensor { .. })), "{error}");
    let silence = Port::new(|_| vec![]);
    let error = serial::probe(&silence.path).unwrap_err();
    assert!(matches!(error, Error::Timeout(_)), "{error}");
    assert!(begun.elapsed() < Duration::from_secs(6), "{:?}", begun.elapsed());
}

#[test]
fn what_cannot_be_a_serial_port_is_named() {
    let open = |path: &str| SerialTransport::open(path.as_ref()).err().unwrap();
    assert!(matches!(open("/dev/ttyUSB-none"), TransportError::NotFound { .. }));
    let file = open("/dev/null");
    assert!(matches!(file, TransportError::NotAPort { .. }), "{file}");
}

#[test]
fn a_bridge_pulled_out_during_a_command_is_gone() {
    let mut port = Port::with_controller();
    let mut link = port.link();
    link.hello().unwrap();
    port.unplug();
    let begun = Instant::now();
    let error = link.call(&GetStatus).unwrap_err();
    assert!(matches!(error, Error::Transport(TransportError::Gone { .. })), "{error}");
    assert!(begun.elapsed() < Duration::from_secs(1));
}

/// Endpoints of a simulated device, called without a bus, in simulated time. Transfers are split into
/// packets of random sizes, and every so often an endpoint halts.
struct DirectPipes {
    function: Mutex<ControlFunction>,
    bench: Arc<Bench>,
    clock: Arc<VirtualClock>,
    /// One transfer in so many halts its endpoint; none when 0.
    halt_every: u64,
    transfers: AtomicU64,
    gone: AtomicBool,
}

impl DirectPipes {
    fn new(halt_every: u64) -> Arc<Self> {
        let rig = Rig::new(Box::<InProcess>::default(), 9_000_000, 8);
        let bench = Arc::new(Bench::virtual_time(rig));
        let mut function = ControlFunction::new(Arc::clone(&bench), "SIM");
        let configure = Setup { request_type: 0, request: 9, value: 1, index: 0, length: 0 };
        assert_eq!(function.control(configure, &[]), Answer::Done(vec![]));
        Arc::new(Self {
            function: Mutex::new(function),
            bench,
            clock: Arc::default(),
            halt_every,
            transfers: AtomicU64::new(0),
            gone: AtomicBool::new(false),
        })
    }

    fn pass(&self, time: Duration) {
        let mut rig = self.bench.rig();
        let to_ns = rig.now_ns() + time.as_nanos() as u64;
        rig.advance(to_ns);
        self.clock.advance_to_ns(rig.now_ns());
    }

    fn next_is_halt(&self) -> bool {
        let count = self.transfers.fetch_add(1, Ordering::Relaxed) + 1;
        self.halt_every > 0 && count.is_multiple_of(self.halt_every)
    }
}

impl Pipes for DirectPipes {
    fn read(&self, endpoint: u8, buffer: &mut [u8], timeout: Duration) -> Result<usize, PipeError> {
        if self.gone.load(Ordering::Acquire) {
            return Err(PipeError::Gone);
        }
        let mut function = self.function.lock().unwrap();
        if !timeout.is_zero() {
            self.pass(timeout);
        }
        // Short packets: whatever part of a frame.
        let most = 1 + self.transfers.load(Ordering::Relaxed) as usize * 7 % buffer.len();
        match function.transfer_in(endpoint & 0xf, most) {
            Answer::Done(bytes) => {
                buffer[..bytes.len()].copy_from_slice(&bytes);
                if self.next_is_halt() {
                    function.halt(endpoint);
                }
                Ok(bytes.len())
            }
            Answer::Nak => Err(PipeError::Timeout),
            Answer::Stall => Err(PipeError::Halted),
            Answer::Broken(_) => Err(PipeError::Gone),
        }
    }

    fn write(&self, endpoint: u8, bytes: &[u8], _: Duration) -> Result<usize, PipeError> {
        if self.gone.load(Ordering::Acquire) {
            return Err(PipeError::Gone);
        }
        let mut function = self.function.lock().unwrap();
        if self.next_is_halt() {
            function.halt(endpoint);
        }
        match function.transfer_out(endpoint, bytes) {
            Answer::Done(written) => Ok(written),
            Answer::Nak => Err(PipeError::Timeout),
            Answer::Stall => Err(PipeError::Halted),
            Answer::Broken(_) => Err(PipeError::Gone),
        }
    }

    fn clear_halt(&self, endpoint: u8) -> Result<(), PipeError> {
        let index = u16::from(endpoint);
        let clear = Setup { request_type: 2, request: 1, value: 0, index, length: 0 };
        self.function.lock().unwrap().control(clear, &[]);
        Ok(())
    }
}

fn usb_link(pipes: &Arc<DirectPipes>) -> (Link, Arc<AtomicU64>) {
    let transport = PolledUsb::new("usb:SIM", Arc::clone(pipes) as _);
    let halts = transport.halts();
    let clock: Arc<dyn Clock> = pipes.clock.clone();
    (Link::new(Box::new(transport), clock), halts)
}

#[test]
fn usb_endpoints() {
    let (mut link, halts) = usb_link(&DirectPipes::new(0));
    protocol_suite(&mut link);
    assert_eq!(halts.load(Ordering::Relaxed), 0);
}

#[test]
fn halted_endpoints_are_cleared_and_requests_repeated() {
    let (mut link, halts) = usb_link(&DirectPipes::new(9));
    link.hello().unwrap();
    for _ in 0..300 {
        link.call(&GetStatus).unwrap();
    }
    assert!(halts.load(Ordering::Relaxed) > 20, "{halts:?}");
}

#[test]
fn a_device_unplugged_during_a_command_is_gone() {
    let pipes = DirectPipes::new(0);
    let (mut link, _) = usb_link(&pipes);
    link.hello().unwrap();
    pipes.gone.store(true, Ordering::Release);
    let error = link.call(&GetStatus).unwrap_err();
    assert!(matches!(error, Error::Transport(TransportError::Gone { .. })), "{error}");
}

/// The same against whatever sensor is plugged into this machine: `--ignored`.
#[test]
#[ignore = "needs a sensor on USB; `cargo xtask e2e` runs it where there is a simulated one"]
fn usb_of_this_machine() {
    let (transport, sensor) = stspp::transport::usb::device::open(None).unwrap();
    assert!(!sensor.serial.is_empty() && sensor.usb_path.contains('-'), "{sensor:?}");
    let again = stspp::transport::usb::device::open(None).err().unwrap();
    assert!(matches!(again, TransportError::Busy { .. }), "{again}");
    let mut link =
        Link::new(Box::new(transport) as Box<dyn Transport>, Arc::new(MonotonicClock::new()));
    protocol_suite(&mut link);
}
