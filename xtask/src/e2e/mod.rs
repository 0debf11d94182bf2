//! `cargo xtask e2e`: simulated USB cameras plugged into a real Linux kernel in QEMU.
//!
//! [`kernel`] fetches a Debian kernel, [`initrd`] packs the guest, [`machine`] boots it and talks to
//! its first process. So far there is one scenario: both cameras attach over USB/IP, and the stock UVC
//! driver makes video and metadata nodes of them. A stage of `cargo xtask test` it becomes with the
//! scenarios that take depth frames in the guest.

mod initrd;
mod kernel;
mod machine;

use crate::{debian, workspace};
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const PACKAGES: &[&str] = &["qemu-system-x86", "kmod", "xz-utils"];

/// How long the kernel may take to make nodes of what was plugged in.
const SETTLE: Duration = Duration::from_secs(20);

/// Runs the scenario and says what the kernel made of the cameras.
///
/// # Errors
/// Which step failed, and what the guest said.
pub fn run() -> Result<String, String> {
    debian::ensure(PACKAGES)?;
    let kernel = kernel::prepare()?;
    let folder = workspace::root().join("target/e2e");
    let (guest, cameras) = build()?;
    let archive = initrd::build(&kernel, &guest, &[])?;
    let image = folder.join("initrd.cpio");
    std::fs::write(&image, archive).map_err(|e| format!("{}: {e}", image.display()))?;

    let server = CameraServer::start(&cameras)?;
    let start = Instant::now();
    let mut machine =
        machine::Machine::boot(&kernel.image, &image, &["left", "right"], server.port, &folder)?;
    println!("guest is up after {:.1} s", start.elapsed().as_secs_f64());
    for (port, bus_id) in [("left", "1-1"), ("right", "1-2")] {
        let reply = machine.request(&["attach", port, bus_id])?;
        if reply.code != 0 {
            return Err(format!("attach {bus_id}: {}", reply.text.trim()));
        }
    }
    let expected = [
        (0, "stspp left camera"),
        (2, "stspp right camera"),
        (1, "stspp left"),
        (3, "stspp right"),
    ];
    let deadline = Instant::now() + SETTLE;
    for (number, name) in expected {
        let path = format!("/sys/class/video4linux/video{number}/name");
        loop {
            let reply = machine.request(&["read", &path])?;
            if reply.code == 0 {
                if !reply.text.starts_with(name) {
                    return Err(format!("video{number} is {:?}, not {name:?}", reply.text.trim()));
                }
                break;
            }
            if Instant::now() > deadline {
                return Err(format!("video{number} did not appear: {}", reply.text.trim()));
            }
            std::thread::sleep(Duration::from_millis(200));
        }
    }
    Ok("two UVC cameras attached over USB/IP: 2 video and 2 metadata nodes".into())
}

/// Builds the guest's first process and the camera server.
fn build() -> Result<(PathBuf, PathBuf), String> {
    for arguments in [
        ["build", "--locked", "--package", "stspp-e2e-guest", "--bin", "guest-init"],
        ["build", "--locked", "--package", "stspp-hil-sim", "--example", "usbip_cameras"],
    ] {
        let status = workspace::cargo().args(arguments).status();
        if !status.is_ok_and(|s| s.success()) {
            return Err(format!("cargo {} failed", arguments.join(" ")));
        }
    }
    let built = workspace::root().join("target/debug");
    Ok((built.join("guest-init"), built.join("examples/usbip_cameras")))
}

/// The camera server as a process of its own; ended when dropped.
struct CameraServer {
    process: Child,
    port: u16,
}

impl CameraServer {
    fn start(program: &PathBuf) -> Result<Self, String> {
        let mut process = Command::new(program)
            .arg("0")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|e| format!("{}: {e}", program.display()))?;
        let mut line = String::new();
        if let Some(stdout) = process.stdout.take() {
            let _ = BufReader::new(stdout).read_line(&mut line);
        }
        let mut server = Self { process, port: 0 };
        server.port = line.trim().parse().map_err(|_| "the camera server did not start")?;
        Ok(server)
    }
}

impl Drop for CameraServer {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
