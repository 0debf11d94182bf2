//! `cargo xtask e2e`: the simulated sensor plugged into a real Linux kernel in QEMU, and the unmodified
//! `stspp` binary in that guest, which uses libusb and V4L2 as on a desk.
//!
//! ```text
//!   this machine                              guest (Debian kernel, no shell, no network)
//!   hil-sim serve ── TCP ── virtio port ──── guest-init ── vhci-hcd ── usbfs, uvcvideo ── stspp
//!   xtask ────────────────── virtio port ──── guest-init runs what it is told
//! ```
//!
//! [`kernel`] fetches a Debian kernel, [`initrd`] packs the guest, [`machine`] boots it and talks to its
//! first process, [`server`] is the simulated sensor, [`bench`](mod@bench) both together, [`scenario`],
//! [`depth`] and [`formats`] what is tried, [`score`] how depth compares with the truth. Everything ends with this
//! process, however that ends.

mod bench;
mod depth;
mod formats;
mod initrd;
mod kernel;
mod machine;
mod scenario;
mod score;
mod server;

use crate::stage::{self, Outcome};
use crate::{debian, firmware, workspace};
use bench::{Bench, DEVICES, SCENE_SCALE, built};
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

/// Debian packages of this stage.
const PACKAGES: &[&str] = &["qemu-system-x86", "kmod", "xz-utils"];

/// No further scenario is begun after this long: what is not compiling ends within six minutes.
const TIME_LIMIT: Duration = Duration::from_secs(330);

/// How long the guest takes to boot on two idle cores. Where other work slows it down, all limits are
/// longer in proportion, at most so many times.
const BOOT_S: f64 = 12.0;
const SLOWNESS_MAX: f64 = 4.0;

/// A scenario that was run.
struct Tried {
    name: &'static str,
    took: Duration,
    result: Result<String, String>,
}

/// Runs all scenarios, or those whose name contains one of `only` (commas between them), and prints a table.
///
/// # Errors
/// Which scenarios failed, or which step before them.
pub fn run(only: Option<&str>) -> Result<String, String> {
    debian::ensure(PACKAGES)?;
    run_with(&kernel::prepare()?, only)
}

/// The same as a stage of the tests: left out where packages or a kernel cannot be had.
pub fn stage() -> Outcome {
    match debian::ensure(PACKAGES).and_then(|()| kernel::prepare()) {
        Err(why) => Outcome::Skipped(why),
        Ok(_) if !firmware::images_are_there() => {
            Outcome::Skipped("there is no firmware to run: see the stage \"firmware\"".into())
        }
        Ok(kernel) => stage::check(run_with(&kernel, None)),
    }
}

fn run_with(kernel: &kernel::Kernel, only: Option<&str>) -> Result<String, String> {
    let folder = workspace::root().join("target/e2e");
    let programs = build()?;
    let begun = Instant::now();
    let server = bench::serve(&folder, SCENE_SCALE, 0, &[])?;
    let in_guest = [("stspp", built("stspp")), ("transports", programs.transports)];
    let archive = initrd::build(kernel, &built("guest-init"), &in_guest)?;
    let image = folder.join("initrd.cpio");
    std::fs::write(&image, archive).map_err(|e| format!("{}: {e}", image.display()))?;

    let start = Instant::now();
    let ports = DEVICES.map(|(_, port, _)| port);
    let machine = machine::Machine::boot(&kernel.image, &image, &ports, server.port, &folder)?;
    let boot_s = start.elapsed().as_secs_f64();
    let slowness = (boot_s / BOOT_S).clamp(1.0, SLOWNESS_MAX);
    println!("guest is up after {boot_s:.1} s; limits {slowness:.1} times as long as usual");
    let time_limit = TIME_LIMIT.mul_f64(slowness);
    let mut bench = Bench::new(machine, server, &folder, slowness);
    bench.plug_all_in(&DEVICES)?;
    let mut outcomes: Vec<Tried> = Vec::new();
    let mut repeated = 0;
    for (name, scenario) in scenario::ALL {
        // What the kernel makes of the devices and the guest's pace come before all else.
        let is_first = outcomes.len() < scenario::FIRST;
        if only.is_some_and(|only| !only.split(',').any(|part| name.contains(part))) && !is_first {
            continue;
        }
        let start = Instant::now();
        let mut result = Err("not begun: the time is up".to_owned());
        if begun.elapsed() < time_limit {
            result = scenario(&mut bench);
        }
        // An emulated machine beside other work now and then stands still for seconds, which no limit
        // foresees. What fails twice is wrong; that it failed once is told.
        if let Err(first) = &result
            && begun.elapsed() < time_limit
        {
            println!("{name:<28} once more after {:.1} s: {first}", start.elapsed().as_secs_f64());
            repeated += 1;
            bench.tidy();
            result = scenario(&mut bench);
        }
        let outcome = Tried { name, took: start.elapsed(), result };
        println!("{}", line(&outcome));
        if outcome.result.is_err() {
            bench.tidy();
        }
        outcomes.push(outcome);
    }
    let failed: Vec<&str> = outcomes.iter().filter(|o| o.result.is_err()).map(|o| o.name).collect();
    let seconds = begun.elapsed().as_secs();
    if failed.is_empty() {
        let again = match repeated {
            0 => String::new(),
            _ => format!(", {repeated} of them at the second try"),
        };
        Ok(format!("{} scenarios in the guest passed in {seconds} s{again}", outcomes.len()))
    } else {
        Err(format!(
            "{} of {} scenarios failed: {}",
            failed.len(),
            outcomes.len(),
            failed.join(", ")
        ))
    }
}

fn line(outcome: &Tried) -> String {
    let (word, text) = match &outcome.result {
        Ok(text) => ("passed", text),
        Err(text) => ("FAILED", text),
    };
    let seconds = outcome.took.as_secs_f64();
    format!("{:<28} {word:<7} {seconds:>6.1} s  {text}", outcome.name)
}

/// What [`build`] has made, besides what has a fixed place.
struct Programs {
    /// The test binary with the protocol suite.
    transports: PathBuf,
}

/// Builds the guest's first process, the simulated sensor with its firmware, and the program under test.
fn build() -> Result<Programs, String> {
    let elf = workspace::root().join("target/firmware/f350.elf");
    if !elf.exists() {
        firmware::run(&["f350"])?;
    }
    for arguments in [
        &["build", "--locked", "--package", "stspp-e2e-guest", "--package", "stspp-hil-serve"][..],
        &["build", "--locked", "--package", "stspp", "--bin", "stspp"],
        &["build", "--locked", "--package", "stspp", "--example", "cloud_against_truth"],
    ] {
        let status = workspace::cargo().args(arguments).status();
        if !status.is_ok_and(|s| s.success()) {
            return Err(format!("cargo {} failed", arguments.join(" ")));
        }
    }
    Ok(Programs { transports: test_binary("stspp", "transports")? })
}

/// Builds an integration test and says where its program is.
fn test_binary(package: &str, test: &str) -> Result<PathBuf, String> {
    let mut command: Command = workspace::cargo();
    command.args(["test", "--locked", "--no-run", "--message-format=json", "--package", package]);
    let output = command
        .args(["--test", test])
        .stderr(std::process::Stdio::inherit())
        .output()
        .map_err(|e| format!("cargo test: {e}"))?;
    String::from_utf8_lossy(&output.stdout)
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
        .filter(|message| message["target"]["name"] == test)
        .find_map(|message| Some(PathBuf::from(message["executable"].as_str()?)))
        .ok_or_else(|| format!("cargo built no test {test}"))
}
