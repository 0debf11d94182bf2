//! Finds a compiler that can build for the chip.

use super::TARGET;
use crate::debian;
use std::fmt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Where the core library comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Core {
    Prebuilt,
    FromSource,
}

/// A compiler that can build for the chip.
#[derive(Debug, Clone)]
pub struct Toolchain {
    rustc: PathBuf,
    core: Core,
    linker: Option<PathBuf>,
}

impl fmt::Display for Toolchain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let core = match self.core {
            Core::Prebuilt => "prebuilt core library",
            Core::FromSource => "core library from source (-Z build-std)",
        };
        write!(f, "firmware compiler: {}, {core}", self.rustc.display())?;
        match &self.linker {
            Some(linker) => write!(f, ", linker {}", linker.display()),
            None => Ok(()),
        }
    }
}

impl Toolchain {
    /// A cargo that uses this compiler.
    pub fn cargo(&self) -> Command {
        let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        cargo.env("RUSTC", &self.rustc).env_remove("RUSTFLAGS").env_remove("CARGO_TARGET_DIR");
        if self.core == Core::FromSource {
            // Lets a stable compiler take `-Z build-std`; affects nothing else in our code.
            cargo.env("RUSTC_BOOTSTRAP", "1");
        }
        if let Some(linker) = &self.linker {
            cargo.env("CARGO_TARGET_THUMBV7EM_NONE_EABIHF_LINKER", linker);
        }
        cargo
    }

    /// Arguments that must follow the subcommand's.
    pub fn finish(&self, cargo: &mut Command) {
        if self.core == Core::FromSource {
            cargo.args(["-Z", "build-std=core"]);
        }
    }
}

/// Finds a compiler, and with `install` gets one where there is none.
///
/// # Errors
/// Says what was looked for and how to install it.
pub fn find(install: bool) -> Result<Toolchain, String> {
    if let Some(found) = look() {
        return Ok(found);
    }
    let mut tried = String::new();
    if install {
        if rustup_target() {
            if let Some(found) = look() {
                return Ok(found);
            }
            tried += "\n`rustup target add` ran, but its core library is not found";
        }
        match debian::ensure(&["rustc-web", "rust-web-src", "lld"]) {
            Ok(()) => match look() {
                Some(found) => return Ok(found),
                None => tried += "\nthe Debian packages are installed, but do not fit together",
            },
            Err(why) => tried += &format!("\n{why}"),
        }
    }
    Err(format!(
        "no compiler here can build for {TARGET}. Any one of these is enough:\n\
         \x20 rustup target add {TARGET}\n\
         \x20 apt-get install --no-install-recommends rustc-web rust-web-src lld   (Debian, as root)\n\
         `cargo xtask firmware --install` does it for you{tried}"
    ))
}

fn rustup_target() -> bool {
    println!("rustup target add {TARGET}");
    Command::new("rustup")
        .args(["target", "add", TARGET])
        .stdin(Stdio::null())
        .status()
        .is_ok_and(|status| status.success())
}

fn look() -> Option<Toolchain> {
    let compilers = ["rustc", "/usr/bin/rustc"];
    let prebuilt =
        compilers.iter().find(|rustc| has_core(rustc)).map(|rustc| (rustc, Core::Prebuilt));
    let source =
        || compilers.iter().find(|rustc| has_sources(rustc)).map(|rustc| (rustc, Core::FromSource));
    let (rustc, core) = prebuilt.or_else(source)?;
    // rustc finds its own rust-lld; a distribution's compiler may have none.
    let own = bundled_lld(rustc);
    let linker = match own {
        Some(_) => None,
        None => Some(compilers.iter().find_map(|other| bundled_lld(other)).or_else(system_lld)?),
    };
    Some(Toolchain { rustc: PathBuf::from(rustc), core, linker })
}

fn ask(rustc: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(rustc).args(arguments).stderr(Stdio::null()).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// The host's target triple.
///
/// # Errors
/// When there is no rustc.
pub fn host() -> Result<String, String> {
    let version = ask("rustc", &["-vV"]).ok_or("rustc could not be run")?;
    let host = version.lines().find_map(|line| line.strip_prefix("host: "));
    host.map(str::to_owned).ok_or_else(|| "rustc -vV names no host".into())
}

fn has_core(rustc: &str) -> bool {
    let Some(folder) = ask(rustc, &["--print", "target-libdir", "--target", TARGET]) else {
        return false;
    };
    let Ok(files) = std::fs::read_dir(folder) else { return false };
    files.flatten().any(|file| file.file_name().to_string_lossy().starts_with("libcore-"))
}

fn has_sources(rustc: &str) -> bool {
    ask(rustc, &["--print", "sysroot"]).is_some_and(|sysroot| {
        Path::new(&sysroot).join("lib/rustlib/src/rust/library/core/src/lib.rs").exists()
    })
}

fn bundled_lld(rustc: &str) -> Option<PathBuf> {
    let sysroot = ask(rustc, &["--print", "sysroot"])?;
    let host = ask(rustc, &["-vV"])?;
    let host = host.lines().find_map(|line| line.strip_prefix("host: "))?;
    let lld = Path::new(&sysroot).join("lib/rustlib").join(host).join("bin/rust-lld");
    lld.exists().then_some(lld)
}

fn system_lld() -> Option<PathBuf> {
    // `exists` follows links: Debian's /usr/bin/rust-lld may dangle.
    ["/usr/bin/rust-lld", "/usr/bin/ld.lld"].into_iter().map(PathBuf::from).find(|lld| lld.exists())
}
