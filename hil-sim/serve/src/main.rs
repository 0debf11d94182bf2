//! `hil-sim serve --usbip`: the simulated sensor as USB devices that a Linux machine attaches.
//!
//! [`sensor`] puts controller, light, cameras and USB devices together; [`pace`] says how fast its time
//! passes; [`console`] lets its user pull cables and inject faults; [`calibration`] writes what a host
//! needs to know of the cameras; [`bench`](mod@bench) measures the server.

mod bench;
mod calibration;
mod console;
mod pace;
mod sensor;

use std::io::{BufRead, Write};
use std::net::TcpListener;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::Ordering;

use clap::{Parser, Subcommand, ValueEnum};

/// The simulated stspp sensor for other programs.
#[derive(Parser)]
#[command(name = "hil-sim", version)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    Serve(Serve),
    Bench(bench::Args),
}

/// Offer the sensor to a Linux machine as USB devices: `modprobe vhci-hcd`, then `usbip attach -r HOST
/// -b 1-1`, `1-2` and `1-3`.
///
/// Commands on standard input pull cables and inject faults (`help` lists them).
#[derive(clap::Args)]
pub struct Serve {
    /// By USB/IP, the only way there is.
    #[arg(long, required = true)]
    usbip: bool,
    /// Address to listen at; port 0 takes a free one.
    #[arg(long, default_value = "127.0.0.1:3240", value_name = "ADDRESS:PORT")]
    listen: String,
    #[command(flatten)]
    simulated: Simulated,
    /// Write the cameras' calibration (camchain.yaml) here and go on.
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
}

/// The sensor and what is before it.
#[derive(clap::Args)]
pub struct Simulated {
    /// Scene before the cameras: a name of `stspp list --scenes` or a mesh file, with
    /// `?OPTION=VALUE&...`.
    #[arg(long, default_value = "sphere")]
    scene: String,
    /// Dot layouts, tolerances and noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Cameras with 1/SCALE of the pixels in each direction: 1, 2, 4, 8 or 16.
    #[arg(long, default_value_t = 1)]
    scale: usize,
    /// How the cameras send a pixel.
    #[arg(long, value_enum, default_value_t = Format::Grey)]
    format: Format,
    /// One camera that sends both pictures side by side, instead of two.
    #[arg(long)]
    side_by_side: bool,
    /// What runs the controller.
    #[arg(long, value_enum, default_value_t = Mcu::F350)]
    mcu: Mcu,
    /// The firmware's ELF [default: that of `cargo xtask firmware`].
    #[arg(long, value_name = "FILE")]
    firmware: Option<PathBuf>,
    /// Let the sensor's time pass more slowly while the host is behind with fetching pictures: nothing is
    /// lost on a machine that is too slow, such as an emulated one.
    #[arg(long)]
    patient: bool,
}

/// How a pixel is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// 8 bits.
    Grey,
    /// 10 bits in 16.
    Y10,
    /// 12 bits in 16.
    Y12,
    /// 12 bits, said to be 16.
    Y16,
    /// 8 bits of luma beside a byte of colour.
    Yuyv,
}

/// What runs the simulated controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Mcu {
    /// The firmware's binary on an emulated GD32F350, with its own USB device.
    F350,
    /// The firmware's logic in this process, behind a USB device with the same descriptors.
    None,
}

fn main() -> ExitCode {
    let result = match Cli::parse().verb {
        Verb::Serve(serve) => run(&serve),
        Verb::Bench(args) => bench::run(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(serve: &Serve) -> Result<(), Box<dyn std::error::Error>> {
    let listener = TcpListener::bind(&serve.listen)
        .map_err(|error| format!("{}: {error}; choose another port by --listen", serve.listen))?;
    let address = listener.local_addr()?;
    let sensor = sensor::Sensor::new(&serve.simulated)?;
    if let Some(path) = &serve.calibration {
        let text = calibration::to_text(sensor.world().model());
        std::fs::write(path, text).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    eprintln!("rendering {} as each light shows it", serve.simulated.scene);
    sensor.prepare();
    let (server, console) = sensor.into_server();
    // The first line of the output is for programs.
    println!("{}", address.port());
    std::io::stdout().flush()?;
    let devices: &[(&str, &str)] = if serve.simulated.side_by_side {
        &[("control interface", "1-1"), ("cameras side by side", "1-2")]
    } else {
        &[("control interface", "1-1"), ("left camera", "1-2"), ("right camera", "1-3")]
    };
    for (name, bus_id) in devices {
        eprintln!(
            "{name}: usbip --tcp-port {} attach -r {} -b {bus_id}",
            address.port(),
            address.ip()
        );
    }
    let stop = server.stop_flag();
    std::thread::Builder::new().name("console".into()).spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            println!("{}", console.command(&line));
            let _ = std::io::stdout().flush();
        }
        // Whoever started this is gone, or wants it to end.
        stop.store(true, Ordering::Relaxed);
    })?;
    server.listen(&listener, |said| eprintln!("{said}"))?;
    Ok(())
}
