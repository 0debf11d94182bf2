//! The simulated sensor (`hil-sim serve --usbip`) as a process of its own; ended when dropped.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// How long the scene may take to render, and a command to be answered.
const PATIENCE: Duration = Duration::from_secs(180);

/// The running server.
pub struct Server {
    process: Child,
    console: Mutex<(ChildStdin, Receiver<String>)>,
    /// Where it listens on this machine.
    pub port: u16,
}

impl Server {
    /// Starts `program` with `arguments`, listening at `port` (0 takes a free one), and waits until it
    /// does; its messages go to `log`.
    ///
    /// # Errors
    /// When it does not start; its last messages are in the text.
    pub fn start(
        program: &Path,
        arguments: &[&str],
        port: u16,
        log: &Path,
    ) -> Result<Self, String> {
        let failed = |e: std::io::Error| format!("{}: {e}", program.display());
        let messages = std::fs::File::create(log).map_err(failed)?;
        let mut command = Command::new(program);
        command.args(["serve", "--usbip", "--listen", &format!("127.0.0.1:{port}")]);
        let mut process = super::machine::dies_with_us(&mut command)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(messages)
            .spawn()
            .map_err(failed)?;
        let (Some(stdin), Some(stdout)) = (process.stdin.take(), process.stdout.take()) else {
            return Err("the simulated sensor has no console".into());
        };
        let (sender, lines) = channel();
        let read = move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    break;
                }
            }
        };
        std::thread::Builder::new().name("hil-sim".into()).spawn(read).map_err(failed)?;
        let first = lines.recv_timeout(PATIENCE).unwrap_or_default();
        let mut server = Self { process, console: Mutex::new((stdin, lines)), port: 0 };
        server.port = first.trim().parse().map_err(|_| {
            let said = std::fs::read_to_string(log).unwrap_or_default();
            format!("the simulated sensor did not start: {}", said.trim())
        })?;
        Ok(server)
    }

    /// Gives a command to the simulated sensor's console; what it answered.
    ///
    /// # Errors
    /// When it does not answer `ok`.
    pub fn command(&self, line: &str) -> Result<String, String> {
        let mut console = self.console.lock().unwrap_or_else(PoisonError::into_inner);
        writeln!(console.0, "{line}").map_err(|e| format!("hil-sim: {e}"))?;
        let answer =
            console.1.recv_timeout(PATIENCE).map_err(|_| format!("hil-sim ignores {line:?}"))?;
        match answer.strip_prefix("ok") {
            Some(rest) => Ok(rest.trim().to_owned()),
            None => Err(format!("hil-sim, {line:?}: {answer}")),
        }
    }

    /// Whether a light is on.
    ///
    /// # Errors
    /// When it does not answer.
    pub fn is_lit(&self) -> Result<bool, String> {
        Ok(self.command("status")?.contains("lit=true"))
    }
}

impl Server {
    /// Ends it.
    pub fn end(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end();
    }
}
