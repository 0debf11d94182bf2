//! `hil-sim bench`: how many pictures a second a host on this machine gets from the served sensor.
//!
//! Server and host are the same as for a kernel: USB/IP over loopback, bulk transfers of the size and
//! number that `uvcvideo` asks for, the sensor streaming in real time. What the kernel does with the
//! bytes afterwards is not in it.

use std::error::Error;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use stspp_hil_sim::front::usbip::client::{Client, Transfer};
use stspp_protocol::message::{Call, encode_request};
use stspp_protocol::request::{Arm, Heartbeat, Hello, StartStream, StopStream};
use stspp_protocol::usb;
use stspp_protocol::version::PROTOCOL_VERSION;
use stspp_protocol::wire::MAX_FRAME_LEN;

use crate::Simulated;
use crate::sensor::Sensor;

/// Bytes of a transfer and how many are under way, as `uvcvideo` has them at high speed.
const TRANSFER: usize = 32 * 512;
const UNDER_WAY: usize = 5;

/// The device goes dark without a heartbeat; twice as often is safe.
const HEARTBEAT: Duration = Duration::from_millis(100);

/// Measure the USB/IP server: both cameras streaming to a host on this machine, in real time.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    simulated: Simulated,
    /// How long to measure.
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
}

/// What a camera's host has counted.
#[derive(Default)]
struct Counted {
    frames: AtomicU64,
    /// Payloads of another length than agreed.
    broken: AtomicU64,
    /// Frames that are missing between two, by the camera's own time.
    lost: AtomicU64,
}

/// Runs the measurement and prints what came of it.
///
/// # Errors
/// When the sensor or a host does not start; when fewer than 99 % of the frames arrive.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let address = listener.local_addr()?;
    let sensor = Sensor::new(&args.simulated)?;
    let (width, height) = (sensor.world().model().left.width, sensor.world().model().left.height);
    eprintln!("rendering {} as each light shows it", args.simulated.scene);
    sensor.prepare();
    let (server, _console) = sensor.into_server();
    let stop = server.stop_flag();
    let serving = std::thread::spawn(move || server.listen(&listener, |_| {}));

    let counted = [Arc::new(Counted::default()), Arc::new(Counted::default())];
    let mut hosts = Vec::new();
    for (bus_id, counted) in ["1-2", "1-3"].into_iter().zip(&counted) {
        let (camera, payload) = start_camera(address, bus_id)?;
        let (counted, stop) = (Arc::clone(counted), Arc::clone(&stop));
        hosts.push(std::thread::spawn(move || fetch(camera, payload, &counted, &stop)));
    }
    let mut control = Control::open(address)?;
    control.request(&Hello { host: PROTOCOL_VERSION })?;
    control.request(&Arm)?;
    control.request(&StartStream)?;
    // The first pictures only fill the pipe.
    control.stay_alive(Duration::from_millis(500))?;
    let frames = || counted.each_ref().map(|c| c.frames.load(Ordering::Relaxed));
    let (before, cpu_before_s, begun) = (frames(), cpu_s("/proc/self/stat"), Instant::now());
    control.stay_alive(Duration::from_secs_f64(args.seconds))?;
    let (after, cpu_after_s) = (frames(), cpu_s("/proc/self/stat"));
    let wall_s = begun.elapsed().as_secs_f64();
    control.request(&StopStream)?;
    stop.store(true, Ordering::Relaxed);
    drop(control);
    // Host threads end with their connections, the server's with the flag.
    let hosts_cpu_s: f64 = hosts.into_iter().filter_map(|host| host.join().ok()).sum();
    let _ = serving.join();

    let bytes = (width * height) as f64;
    let rates = [0, 1].map(|at| (after[at] - before[at]) as f64 / wall_s);
    let sum = |count: fn(&Counted) -> &AtomicU64| -> u64 {
        counted.iter().map(|c| count(c).load(Ordering::Relaxed)).sum()
    };
    let (broken, lost) = (sum(|c| &c.broken), sum(|c| &c.lost));
    println!(
        "2 x {width}x{height}: {:.2} and {:.2} frames/s, {:.1} MB/s over {wall_s:.1} s; {lost} lost, \
         {broken} broken; CPU {:.0} % of a core, of which the hosts {:.0} %",
        rates[0],
        rates[1],
        (rates[0] + rates[1]) * bytes * 1e-6,
        100.0 * (cpu_after_s - cpu_before_s) / wall_s,
        100.0 * hosts_cpu_s / wall_s,
    );
    if broken == 0 && rates.iter().all(|rate| *rate >= 29.7) {
        Ok(())
    } else {
        Err("the sensor takes 30 frames a second; they did not all arrive".into())
    }
}

/// CPU time of a process or thread by its `stat` file, seconds.
fn cpu_s(stat: &str) -> f64 {
    const TICKS_PER_S: f64 = 100.0;
    let text = std::fs::read_to_string(stat).unwrap_or_default();
    // Fields 14 and 15; the name in parentheses may hold spaces.
    let fields = text.rsplit_once(')').map_or("", |(_, rest)| rest).split_whitespace();
    fields.skip(11).take(2).filter_map(|field| field.parse::<f64>().ok()).sum::<f64>() / TICKS_PER_S
}

fn configured(address: SocketAddr, bus_id: &str) -> Result<Client, Box<dyn Error>> {
    let mut client = Client::connect(address)?;
    client.import(bus_id)?.ok_or_else(|| format!("{bus_id} is refused"))?;
    match client.control([0, 9, 1, 0, 0, 0, 0, 0], &[])?.status {
        0 => Ok(client),
        status => Err(format!("{bus_id} cannot be configured: {status}").into()),
    }
}

/// Attaches a camera and starts its stream; the length of its payloads.
fn start_camera(address: SocketAddr, bus_id: &str) -> Result<(Client, usize), Box<dyn Error>> {
    let mut client = configured(address, bus_id)?;
    let probe = client.control([0xa1, 0x81, 0, 1, 1, 0, 34, 0], &[])?.data;
    let payload = probe.get(22..26).and_then(|bytes| bytes.try_into().ok());
    let payload = u32::from_le_bytes(payload.ok_or("no answer to the probe")?) as usize;
    match client.control([0x21, 1, 0, 2, 1, 0, 34, 0], &probe)?.status {
        0 => Ok((client, payload)),
        status => Err(format!("{bus_id} does not stream: {status}").into()),
    }
}

/// Fetches pictures until the connection ends; the CPU time that took.
fn fetch(mut camera: Client, payload: usize, counted: &Counted, stop: &AtomicBool) -> f64 {
    let transfer =
        Transfer { is_in: true, endpoint: 1, length: TRANSFER, setup: [0; 8], data: &[] };
    let mut under_way = (0..UNDER_WAY).try_for_each(|_| camera.submit(&transfer).map(drop));
    let (mut length, mut head) = (0, Vec::new());
    let mut last_ticks = None;
    while under_way.is_ok() && !stop.load(Ordering::Relaxed) {
        let Ok(reply) = camera.reply() else { break };
        under_way = camera.submit(&transfer).map(drop);
        if length == 0 {
            head = reply.data.get(2..6).map(<[u8]>::to_vec).unwrap_or_default();
        }
        length += reply.data.len();
        if reply.data.len() == TRANSFER {
            continue;
        }
        let whole = length == payload;
        counted.frames.fetch_add(u64::from(whole), Ordering::Relaxed);
        counted.broken.fetch_add(u64::from(!whole), Ordering::Relaxed);
        length = 0;
        let ticks = head.as_slice().try_into().map(u32::from_le_bytes).ok();
        if let (Some(last), Some(now)) = (last_ticks, ticks) {
            let periods = f64::from(now.wrapping_sub(last)) * 30.0 / 48e6;
            counted.lost.fetch_add((periods.round() as u64).saturating_sub(1), Ordering::Relaxed);
        }
        last_ticks = ticks.or(last_ticks);
    }
    cpu_s("/proc/thread-self/stat")
}

/// The control interface.
struct Control {
    client: Client,
    sequence: u16,
    replies: u32,
    events: u32,
}

impl Control {
    fn open(address: SocketAddr) -> Result<Self, Box<dyn Error>> {
        let mut client = configured(address, "1-1")?;
        let replies = Self::listen(&mut client, usb::ENDPOINT_REPLIES)?;
        let events = Self::listen(&mut client, usb::ENDPOINT_EVENTS)?;
        Ok(Self { client, sequence: 0, replies, events })
    }

    fn listen(client: &mut Client, endpoint: u8) -> std::io::Result<u32> {
        let endpoint = endpoint & 0x0f;
        client.submit(&Transfer { is_in: true, endpoint, length: 512, setup: [0; 8], data: &[] })
    }

    /// Sends a request and waits until something is answered.
    fn request<C: Call>(&mut self, request: &C) -> Result<(), Box<dyn Error>> {
        let mut out = [0; MAX_FRAME_LEN];
        self.sequence = self.sequence.wrapping_add(1);
        let bytes =
            encode_request(self.sequence, request, &mut out).map_err(|_| "request too long")?;
        let endpoint = usb::ENDPOINT_REQUESTS;
        let (is_in, length, setup) = (false, bytes.len(), [0; 8]);
        self.client.submit(&Transfer { is_in, endpoint, length, setup, data: bytes })?;
        loop {
            let reply = self.client.reply()?;
            if reply.sequence == self.events {
                self.events = Self::listen(&mut self.client, usb::ENDPOINT_EVENTS)?;
            } else if reply.sequence == self.replies {
                self.replies = Self::listen(&mut self.client, usb::ENDPOINT_REPLIES)?;
                return Ok(());
            } else if reply.status != 0 {
                return Err(format!("the request failed with {}", reply.status).into());
            }
        }
    }

    /// Sends heartbeats for a while.
    fn stay_alive(&mut self, time: Duration) -> Result<(), Box<dyn Error>> {
        let begun = Instant::now();
        while let Some(left) = time.checked_sub(begun.elapsed()).filter(|left| !left.is_zero()) {
            self.request(&Heartbeat)?;
            std::thread::sleep(left.min(HEARTBEAT));
        }
        Ok(())
    }
}
