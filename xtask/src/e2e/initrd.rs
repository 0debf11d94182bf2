//! The guest's file system: a cpio archive ("newc") with our programs, the libraries they need, and
//! the kernel modules.

use super::kernel::Kernel;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

/// An archive in the making.
#[derive(Default)]
pub struct Archive {
    bytes: Vec<u8>,
    folders: BTreeSet<PathBuf>,
    files: u32,
}

impl Archive {
    /// Adds a file and the folders above it.
    pub fn file(&mut self, path: &str, mode: u32, content: &[u8]) {
        let parent = Path::new(path).parent().unwrap_or(Path::new(""));
        let mut missing: Vec<PathBuf> = parent
            .ancestors()
            .filter(|folder| !folder.as_os_str().is_empty() && !self.folders.contains(*folder))
            .map(Path::to_path_buf)
            .collect();
        missing.reverse();
        for folder in missing {
            self.entry(&folder.to_string_lossy(), 0o040_755, &[]);
            self.folders.insert(folder);
        }
        self.entry(path, 0o100_000 | mode, content);
    }

    /// The archive, closed.
    pub fn finish(mut self) -> Vec<u8> {
        self.entry("TRAILER!!!", 0, &[]);
        self.bytes
    }

    fn entry(&mut self, path: &str, mode: u32, content: &[u8]) {
        self.files += 1;
        let fields = [
            self.files,
            mode,
            0,
            0,
            1,
            0,
            content.len() as u32,
            0,
            0,
            0,
            0,
            path.len() as u32 + 1,
            0,
        ];
        self.bytes.extend(b"070701");
        for field in fields {
            self.bytes.extend(format!("{field:08X}").as_bytes());
        }
        self.bytes.extend(path.as_bytes());
        self.bytes.push(0);
        self.pad();
        self.bytes.extend(content);
        self.pad();
    }

    fn pad(&mut self) {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
    }
}

/// The guest's archive: `init` as first process, `programs` under /bin by the names given.
///
/// # Errors
/// Names the file that could not be read.
pub fn build(
    kernel: &Kernel,
    init: &Path,
    programs: &[(&str, PathBuf)],
) -> Result<Vec<u8>, String> {
    let mut archive = Archive::default();
    let mut libraries = BTreeSet::new();
    archive.file("init", 0o755, &read(init)?);
    libraries.extend(needs(init)?);
    for (name, program) in programs {
        archive.file(&format!("bin/{name}"), 0o755, &read(program)?);
        libraries.extend(needs(program)?);
    }
    for library in libraries {
        let at = library.to_string_lossy();
        archive.file(at.trim_start_matches('/'), 0o755, &read(&library)?);
    }
    let mut order = String::new();
    for (number, module) in kernel.modules.iter().enumerate() {
        let name = module.file_name().unwrap_or_default().to_string_lossy();
        let plain = name.trim_end_matches(".xz");
        let path = format!("modules/{number:02}-{plain}");
        let content = if plain == name { read(module)? } else { decompressed(module)? };
        archive.file(&path, 0o644, &content);
        order += &format!("/{path}\n");
    }
    archive.file("modules/order", 0o644, order.as_bytes());
    Ok(archive.finish())
}

fn read(path: &Path) -> Result<Vec<u8>, String> {
    std::fs::read(path).map_err(|e| format!("{}: {e}", path.display()))
}

fn decompressed(path: &Path) -> Result<Vec<u8>, String> {
    let output = Command::new("xz").args(["-dc"]).arg(path).output();
    let output = output.map_err(|e| format!("xz could not be run: {e}"))?;
    if output.status.success() {
        Ok(output.stdout)
    } else {
        Err(format!("{}: xz ended with {}", path.display(), output.status))
    }
}

/// Shared libraries of a program, its loader included, as `ldd` finds them.
fn needs(program: &Path) -> Result<Vec<PathBuf>, String> {
    let output = Command::new("ldd")
        .arg(program)
        .output()
        .map_err(|e| format!("ldd could not be run: {e}"))?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    Ok(text
        .split_whitespace()
        .filter(|word| word.starts_with('/'))
        .map(|word| PathBuf::from(word.trim_end_matches(':')))
        .filter(|path| path != program)
        .collect())
}

#[cfg(test)]
mod tests {
    use super::Archive;

    #[test]
    fn entries_are_aligned_and_folders_come_first() {
        let mut archive = Archive::default();
        archive.file("a/b/c", 0o644, b"12345");
        archive.file("a/b/d", 0o644, b"");
        let bytes = archive.finish();
        assert_eq!(bytes.len() % 4, 0);
        let names: Vec<String> = bytes
            .windows(6)
            .enumerate()
            .filter(|(at, window)| *window == b"070701" && at % 4 == 0)
            .map(|(at, _)| {
                let name = &bytes[at + 110..];
                let end = name.iter().position(|b| *b == 0).unwrap();
                String::from_utf8_lossy(&name[..end]).into_owned()
            })
            .collect();
        assert_eq!(names, ["a", "a/b", "a/b/c", "a/b/d", "TRAILER!!!"]);
    }
}
