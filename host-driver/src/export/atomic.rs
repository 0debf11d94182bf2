//! Outputs that appear whole or not at all: written beside their place, flushed to the disk, renamed.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

/// A name beside `path` that no other writer uses.
fn beside(path: &Path) -> PathBuf {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    let name = path.file_name().map_or_else(Default::default, |name| name.to_string_lossy());
    path.with_file_name(format!(".{name}.{}-{count}.part", std::process::id()))
}

/// Removes what was begun unless it was finished.
struct Begun {
    path: PathBuf,
    finished: bool,
}

impl Drop for Begun {
    fn drop(&mut self) {
        if !self.finished {
            // Nothing better can be done about a failure here than to report the first one.
            let _ = if self.path.is_dir() {
                fs::remove_dir_all(&self.path)
            } else {
                fs::remove_file(&self.path)
            };
        }
    }
}

/// Writes the file `path` by `fill`. When `fill` or the disk fails, `path` is as it was before and
/// nothing is left beside it.
///
/// # Errors
/// From `fill`, or from the file system.
pub fn write_file(
    path: &Path,
    fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> io::Result<()> {
    let mut begun = Begun { path: beside(path), finished: false };
    let mut out = BufWriter::new(File::create_new(&begun.path)?);
    fill(&mut out)?;
    let file = out.into_inner().map_err(io::IntoInnerError::into_error)?;
    // A full disk may show only here.
    file.sync_all()?;
    drop(file);
    fs::rename(&begun.path, path)?;
    begun.finished = true;
    Ok(())
}
