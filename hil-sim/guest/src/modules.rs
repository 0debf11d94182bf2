//! Kernel modules, in the order that the host worked out.

use crate::sys;
use std::io;

/// Loads the files that `list` names, a line each.
///
/// # Errors
/// Names the module that did not load.
pub fn load_all(list: &str) -> io::Result<()> {
    for path in std::fs::read_to_string(list)?.lines() {
        std::fs::File::open(path)
            .and_then(|file| sys::load_module(&file))
            .map_err(|e| io::Error::other(format!("module {path}: {e}")))?;
    }
    Ok(())
}
