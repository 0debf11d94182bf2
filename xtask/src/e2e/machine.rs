//! The virtual machine: QEMU without KVM, and the control port into it.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A running machine; ended when dropped, whatever happened.
pub struct Machine {
    qemu: Child,
    control: BufReader<UnixStream>,
    folder: PathBuf,
}

/// What a request came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reply {
    /// Exit code of the program, 0 when the request itself was carried out.
    pub code: i32,
    /// What it printed, or the answer.
    pub text: String,
}

impl Machine {
    /// Boots `kernel` with `initrd`. Each of `ports` is a virtio port by that name, joined to the
    /// TCP server at `usbip_port`. `folder` takes sockets and the console's log.
    ///
    /// # Errors
    /// When QEMU does not start or the guest does not answer within two minutes; the console's last
    /// lines are in the message.
    pub fn boot(
        kernel: &Path,
        initrd: &Path,
        ports: &[&str],
        usbip_port: u16,
        folder: &Path,
    ) -> Result<Self, String> {
        let socket = folder.join("control.sock");
        let _ = std::fs::remove_file(&socket);
        let console = folder.join("console.log");
        let mut command = Command::new("qemu-system-x86_64");
        command
            .args(["-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2", "-m", "1536"])
            .args(["-nographic", "-nodefaults", "-no-reboot", "-monitor", "none"])
            .arg("-kernel")
            .arg(kernel)
            .arg("-initrd")
            .arg(initrd)
            .args(["-append", "console=ttyS0 quiet panic=-1 mitigations=off"])
            .args(["-serial", &format!("file:{}", console.display())])
            .args(["-device", "virtio-serial-pci,max_ports=16"])
            .arg("-chardev")
            .arg(format!("socket,id=control,path={},server=on,wait=off", socket.display()))
            .args(["-device", "virtserialport,chardev=control,name=control"]);
        for port in ports {
            command
                .arg("-chardev")
                .arg(format!("socket,id={port},host=127.0.0.1,port={usbip_port}"))
                .args(["-device", &format!("virtserialport,chardev={port},name={port}")]);
        }
        let mut qemu = command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(File::create(folder.join("qemu.log")).map_err(|e| format!("qemu's log: {e}"))?)
            .spawn()
            .map_err(|e| format!("qemu-system-x86_64 could not be run: {e}"))?;
        let deadline = Instant::now() + Duration::from_secs(120);
        let stream = loop {
            if let Ok(stream) = UnixStream::connect(&socket) {
                break stream;
            }
            let ended = qemu.try_wait().ok().flatten();
            if ended.is_some() || Instant::now() > deadline {
                let _ = qemu.kill();
                let _ = qemu.wait();
                return Err(format!("QEMU did not start\n{}", tail(&folder.join("qemu.log"))));
            }
            std::thread::sleep(Duration::from_millis(50));
        };
        stream
            .set_read_timeout(Some(Duration::from_secs(120)))
            .map_err(|e| format!("control port: {e}"))?;
        let mut machine =
            Self { qemu, control: BufReader::new(stream), folder: folder.to_path_buf() };
        // What is written before the guest is up waits in the port.
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let seconds = now.map_or(0, |d| d.as_secs()).to_string();
        machine
            .request(&["clock", &seconds])
            .map_err(|e| format!("the guest did not come up: {e}\n{}", tail(&console)))?;
        Ok(machine)
    }

    /// Sends a request and waits for its end.
    ///
    /// # Errors
    /// When the machine does not answer.
    pub fn request(&mut self, words: &[&str]) -> Result<Reply, String> {
        let line = words.join("\x1f") + "\n";
        let failed = |e: std::io::Error| format!("control port: {e}");
        self.control.get_mut().write_all(line.as_bytes()).map_err(failed)?;
        let mut text = Vec::new();
        loop {
            let mut head = String::new();
            if self.control.read_line(&mut head).map_err(failed)? == 0 {
                let console = tail(&self.folder.join("console.log"));
                return Err(format!("the machine went away\n{console}"));
            }
            match head.trim_end().split_once(' ') {
                Some(("o", length)) => {
                    let length: usize = length.parse().map_err(|_| "broken answer")?;
                    let from = text.len();
                    text.resize(from + length, 0);
                    self.control.read_exact(&mut text[from..]).map_err(failed)?;
                }
                Some(("x", code)) => {
                    let code = code.parse().map_err(|_| "broken answer")?;
                    return Ok(Reply { code, text: String::from_utf8_lossy(&text).into_owned() });
                }
                _ => return Err(format!("broken answer {head:?}")),
            }
        }
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
    }
}

fn tail(path: &Path) -> String {
    let bytes = std::fs::read(path).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let lines: Vec<&str> = text.lines().collect();
    lines[lines.len().saturating_sub(30)..].join("\n")
}
