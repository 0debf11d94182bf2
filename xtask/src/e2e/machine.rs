//! The virtual machine: QEMU without KVM, and the control port into it.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Longest wait for an answer: more than any program in the guest may take.
const PATIENCE: Duration = Duration::from_secs(800);

/// All that QEMU can emulate, but for "enhanced rep movsb": kernel and C library copy memory by that
/// instruction where it is there, and QEMU emulates it byte by byte. Without it both copy by words,
/// which is seven times faster (118 against 810 MB/s through a socket).
const CPU: &str = "max,-erms";

/// A running machine; ended when dropped, whatever happened.
pub struct Machine {
    qemu: Child,
    control: BufReader<UnixStream>,
    side: BufReader<UnixStream>,
    folder: PathBuf,
}

/// What a request came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reply {
    /// Exit code of the program, 0 when the request itself was carried out.
    pub code: i32,
    /// What it printed, or the answer.
    pub bytes: Vec<u8>,
}

impl Reply {
    /// The answer as text.
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.bytes).into_owned()
    }
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
        let sockets = ["control", "side"].map(|name| (name, folder.join(format!("{name}.sock"))));
        for (_, socket) in &sockets {
            let _ = std::fs::remove_file(socket);
        }
        let console = folder.join("console.log");
        let mut command = Command::new("qemu-system-x86_64");
        command
            .args(["-accel", "tcg,thread=multi", "-cpu", CPU, "-smp", "2", "-m", "1536"])
            .args(["-nographic", "-nodefaults", "-no-reboot", "-monitor", "none"])
            .arg("-kernel")
            .arg(kernel)
            .arg("-initrd")
            .arg(initrd)
            .args(["-append", "console=ttyS0 loglevel=3 panic=-1 mitigations=off"])
            .args(["-serial", &format!("file:{}", console.display())])
            .args(["-device", "virtio-serial-pci,max_ports=16"]);
        for (name, socket) in &sockets {
            command
                .arg("-chardev")
                .arg(format!("socket,id={name},path={},server=on,wait=off", socket.display()))
                .args(["-device", &format!("virtserialport,chardev={name},name={name}")]);
        }
        for port in ports {
            command
                .arg("-chardev")
                .arg(format!("socket,id={port},host=127.0.0.1,port={usbip_port},reconnect=1"))
                .args(["-device", &format!("virtserialport,chardev={port},name={port}")]);
        }
        let mut qemu = dies_with_us(&mut command)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(File::create(folder.join("qemu.log")).map_err(|e| format!("qemu's log: {e}"))?)
            .spawn()
            .map_err(|e| format!("qemu-system-x86_64 could not be run: {e}"))?;
        let mut connect = |socket: &Path| -> Result<BufReader<UnixStream>, String> {
            let deadline = Instant::now() + Duration::from_secs(120);
            let stream = loop {
                if let Ok(stream) = UnixStream::connect(socket) {
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
            stream.set_read_timeout(Some(PATIENCE)).map_err(|e| format!("control port: {e}"))?;
            Ok(BufReader::new(stream))
        };
        let (control, side) = (connect(&sockets[0].1)?, connect(&sockets[1].1)?);
        let mut machine = Self { qemu, control, side, folder: folder.to_path_buf() };
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
        self.send(words)?;
        self.receive()
    }

    /// Sends a request without waiting: [`Machine::receive`] does that.
    ///
    /// # Errors
    /// When the port is closed.
    pub fn send(&mut self, words: &[&str]) -> Result<(), String> {
        write(&mut self.control, words)
    }

    /// Waits for the end of the request sent last.
    ///
    /// # Errors
    /// When the machine does not answer.
    pub fn receive(&mut self) -> Result<Reply, String> {
        read(&mut self.control).map_err(|e| self.explain(&e))
    }

    /// A request beside one that is under way.
    ///
    /// # Errors
    /// When the machine does not answer.
    pub fn side(&mut self, words: &[&str]) -> Result<Reply, String> {
        write(&mut self.side, words)?;
        read(&mut self.side).map_err(|e| self.explain(&e))
    }

    fn explain(&self, error: &str) -> String {
        format!("{error}\n{}", tail(&self.folder.join("console.log")))
    }
}

/// Has a child killed when this thread ends, even by a signal that nothing can be done about.
pub fn dies_with_us(command: &mut Command) -> &mut Command {
    // SAFETY: prctl with PR_SET_PDEATHSIG is a plain system call, which may be made between fork and
    // exec, and touches no memory.
    unsafe {
        command.pre_exec(|| {
            libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL);
            Ok(())
        })
    }
}

fn write(port: &mut BufReader<UnixStream>, words: &[&str]) -> Result<(), String> {
    let line = words.join("\x1f") + "\n";
    port.get_mut().write_all(line.as_bytes()).map_err(|e| format!("control port: {e}"))
}

fn read(port: &mut BufReader<UnixStream>) -> Result<Reply, String> {
    let failed = |e: std::io::Error| format!("control port: {e}");
    let mut bytes = Vec::new();
    loop {
        let mut head = String::new();
        if port.read_line(&mut head).map_err(failed)? == 0 {
            return Err("the machine went away".into());
        }
        match head.trim_end().split_once(' ') {
            Some(("o", length)) => {
                let length: usize = length.parse().map_err(|_| "broken answer")?;
                let from = bytes.len();
                bytes.resize(from + length, 0);
                port.read_exact(&mut bytes[from..]).map_err(failed)?;
            }
            Some(("x", code)) => {
                let code = code.parse().map_err(|_| "broken answer")?;
                return Ok(Reply { code, bytes });
            }
            _ => return Err(format!("broken answer {head:?}")),
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
