//! What the host asks for, a line each over the port `control` or, beside a program that is running,
//! `side`; words apart by the unit separator (0x1f):
//!
//! * `run SECONDS PROGRAM ARGUMENT...`: answers with the program's output as it comes, then its exit
//!   code; a program that takes longer is killed (code 124)
//! * `attach PORT BUSID`, `detach N`: see [`crate::bridge`]
//! * `read FILE`: the file's bytes
//! * `write FILE TEXT`: the file, its lines apart by the record separator (0x1e)
//! * `clock SECONDS`: sets the clock
//! * `poweroff`
//!
//! An answer is records of `o LENGTH\n` and that many bytes, closed by `x CODE\n`.

use crate::{bridge, ports, sys};
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Serves a port until `poweroff` or its end.
///
/// # Errors
/// The port's.
pub fn serve(name: &str) -> io::Result<()> {
    let port = ports::open(name)?;
    let answer = Arc::new(Mutex::new(port.try_clone()?));
    for line in BufReader::new(port).lines() {
        let line = line?;
        let words: Vec<&str> = line.split('\x1f').collect();
        let outcome = match words.as_slice() {
            ["run", seconds, program, arguments @ ..] => {
                run(seconds.parse().unwrap_or(10), program, arguments, &answer)
            }
            ["attach", port, bus_id] => {
                bridge::attach(port, bus_id).and_then(|n| say(&answer, n.to_string().as_bytes()))
            }
            ["detach", n] => bridge::detach(n.parse().unwrap_or(0)),
            ["read", file] => std::fs::read(file).and_then(|bytes| say(&answer, &bytes)),
            ["write", file, text] => write(file.as_ref(), &text.replace('\x1e', "\n")),
            ["clock", seconds] => sys::set_clock(seconds.parse().unwrap_or(0)),
            ["poweroff"] => return finish(&answer, 0),
            _ => Err(io::Error::other("unknown request")),
        };
        match outcome {
            Ok(()) => finish(&answer, 0)?,
            Err(e) => {
                let code = e.get_ref().and_then(|e| e.downcast_ref::<ExitCode>()).map(|c| c.0);
                if code.is_none() {
                    say(&answer, format!("{e}\n").as_bytes())?;
                }
                finish(&answer, code.unwrap_or(125))?;
            }
        }
    }
    Ok(())
}

fn write(file: &Path, text: &str) -> io::Result<()> {
    file.parent().map_or(Ok(()), std::fs::create_dir_all)?;
    std::fs::write(file, text)
}

/// A program ended with this code.
#[derive(Debug)]
struct ExitCode(i32);

impl std::fmt::Display for ExitCode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "exit code {}", self.0)
    }
}

impl std::error::Error for ExitCode {}

fn run(seconds: u64, program: &str, words: &[&str], answer: &Arc<Mutex<File>>) -> io::Result<()> {
    let mut child = Command::new(program)
        .args(words)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let stdout = child.stdout.take().map(|s| forward(s, answer));
    let stderr = child.stderr.take().map(|s| forward(s, answer));
    let deadline = Instant::now() + Duration::from_secs(seconds);
    let code = loop {
        if let Some(status) = child.try_wait()? {
            break status.code().unwrap_or(128);
        }
        if Instant::now() > deadline {
            child.kill()?;
            child.wait()?;
            break 124;
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    for thread in [stdout, stderr].into_iter().flatten() {
        let _ = thread.join();
    }
    if code == 0 { Ok(()) } else { Err(io::Error::other(ExitCode(code))) }
}

fn forward(
    mut from: impl Read + Send + 'static,
    answer: &Arc<Mutex<File>>,
) -> std::thread::JoinHandle<()> {
    let answer = answer.clone();
    std::thread::spawn(move || {
        let mut buffer = [0; 4096];
        while let Ok(count @ 1..) = from.read(&mut buffer) {
            if say(&answer, &buffer[..count]).is_err() {
                break;
            }
        }
    })
}

fn say(answer: &Mutex<File>, bytes: &[u8]) -> io::Result<()> {
    let mut record = format!("o {}\n", bytes.len()).into_bytes();
    record.extend(bytes);
    lock(answer)?.write_all(&record)
}

fn finish(answer: &Mutex<File>, code: i32) -> io::Result<()> {
    lock(answer)?.write_all(format!("x {code}\n").as_bytes())
}

fn lock(answer: &Mutex<File>) -> io::Result<std::sync::MutexGuard<'_, File>> {
    answer.lock().map_err(|_| io::Error::other("a thread has died"))
}
