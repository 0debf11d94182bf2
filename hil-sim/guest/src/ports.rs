//! Virtio serial ports by the names that the host gave them.

use std::fs::{File, OpenOptions};
use std::io;
use std::time::{Duration, Instant};

/// Opens the port called `name`, waiting for it to appear.
///
/// # Errors
/// When there is no such port after ten seconds.
pub fn open(name: &str) -> io::Result<File> {
    let deadline = Instant::now() + Duration::from_secs(10);
    loop {
        if let Some(node) = find(name) {
            return OpenOptions::new().read(true).write(true).open(node);
        }
        if Instant::now() > deadline {
            return Err(io::Error::other(format!("no virtio port is called {name}")));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn find(name: &str) -> Option<String> {
    std::fs::read_dir("/sys/class/virtio-ports").ok()?.flatten().find_map(|entry| {
        let named = std::fs::read_to_string(entry.path().join("name")).ok()?;
        (named.trim() == name).then(|| format!("/dev/{}", entry.file_name().to_string_lossy()))
    })
}
