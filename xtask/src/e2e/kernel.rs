//! A Debian kernel and those of its modules that the guest needs, unpacked beside the build: nothing
//! is installed on the machine for it.

use crate::workspace::root;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Modules that the guest asks for; what they need comes with them.
const WANTED: &[&str] =
    &["virtio_pci", "virtio_console", "vhci-hcd", "uvcvideo", "cdc-acm", "usbmon"];

/// An unpacked kernel.
pub struct Kernel {
    /// The image that QEMU boots.
    pub image: PathBuf,
    /// Module files in the order in which they load.
    pub modules: Vec<PathBuf>,
}

/// Fetches and unpacks the newest kernel of the Debian release at hand, once.
///
/// # Errors
/// Says which step failed.
pub fn prepare() -> Result<Kernel, String> {
    let package = newest_package()?;
    let folder = root().join("target/e2e").join(&package);
    if !folder.join("complete").exists() {
        fetch(&package, &folder)?;
    }
    let release = package.trim_start_matches("linux-image-");
    let modules_folder = ["usr/lib/modules", "lib/modules"]
        .iter()
        .map(|base| folder.join(base).join(release))
        .find(|path| path.exists())
        .ok_or_else(|| format!("{package} has no modules"))?;
    let modules = load_order(&modules_folder)?;
    Ok(Kernel { image: folder.join("boot").join(format!("vmlinuz-{release}")), modules })
}

/// The package that `linux-image-amd64` stands for.
fn newest_package() -> Result<String, String> {
    let output = Command::new("apt-cache")
        .args(["depends", "linux-image-amd64"])
        .stderr(Stdio::null())
        .output()
        .map_err(|e| format!("apt-cache could not be run: {e}"))?;
    String::from_utf8_lossy(&output.stdout)
        .lines()
        .filter_map(|line| line.trim().strip_prefix("Depends: "))
        .find(|name| name.starts_with("linux-image-"))
        .map(str::to_owned)
        .ok_or_else(|| "apt knows no linux-image-amd64 (apt-get update?)".into())
}

fn fetch(package: &str, folder: &Path) -> Result<(), String> {
    println!("fetching {package}");
    let failed = |what: &str, e: &dyn std::fmt::Display| format!("{what} {package}: {e}");
    let _ = std::fs::remove_dir_all(folder);
    std::fs::create_dir_all(folder).map_err(|e| failed("folder of", &e))?;
    let status = Command::new("apt-get")
        .args(["-qq", "-o", "APT::Sandbox::User=root", "download", package])
        .current_dir(folder)
        .stdout(Stdio::null())
        .status()
        .map_err(|e| failed("download of", &e))?;
    if !status.success() {
        return Err(failed("download of", &status));
    }
    let archive = std::fs::read_dir(folder)
        .map_err(|e| failed("folder of", &e))?
        .flatten()
        .map(|entry| entry.path())
        .find(|path| path.extension().is_some_and(|e| e == "deb"))
        .ok_or_else(|| failed("download of", &"no file"))?;
    let status = Command::new("dpkg-deb")
        .arg("--extract")
        .args([&archive, folder])
        .status()
        .map_err(|e| failed("unpacking", &e))?;
    if !status.success() {
        return Err(failed("unpacking", &status));
    }
    std::fs::remove_file(&archive).map_err(|e| failed("archive of", &e))?;
    std::fs::write(folder.join("complete"), "").map_err(|e| failed("folder of", &e))
}

/// [`WANTED`] and what they depend on, dependencies first, without what is built in.
fn load_order(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let read = |name: &str| {
        let path = folder.join(name);
        std::fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))
    };
    // A freshly unpacked package has no modules.dep: that is made when a kernel is installed.
    if !folder.join("modules.dep").exists() {
        let base = folder.ancestors().nth(3).filter(|_| folder.ends_with(folder));
        let base = base.ok_or("modules in an unexpected place")?;
        let release = folder.file_name().map(|n| n.to_string_lossy().into_owned());
        let status = Command::new("depmod")
            .arg("-b")
            .arg(base)
            .arg(release.unwrap_or_default())
            .status()
            .map_err(|e| format!("depmod could not be run: {e}"))?;
        if !status.success() {
            return Err(format!("depmod ended with {status}"));
        }
    }
    let dependencies = read("modules.dep")?;
    let table: HashMap<&str, (&str, Vec<&str>)> = dependencies
        .lines()
        .filter_map(|line| line.split_once(':'))
        .map(|(path, needs)| (module_name(path), (path, needs.split_whitespace().collect())))
        .collect();
    let built_in = read("modules.builtin")?;
    let mut order: Vec<&str> = Vec::new();
    for wanted in WANTED {
        match table.iter().find(|(name, _)| same_name(name, wanted)) {
            Some((_, (path, needs))) => {
                // modules.dep lists the nearest dependency first.
                for file in needs.iter().rev().chain([path]) {
                    if !order.contains(file) {
                        order.push(file);
                    }
                }
            }
            None if built_in.lines().any(|line| same_name(module_name(line), wanted)) => {}
            None => return Err(format!("the kernel has no module {wanted}")),
        }
    }
    Ok(order.into_iter().map(|file| folder.join(file)).collect())
}

fn module_name(path: &str) -> &str {
    let name = path.rsplit('/').next().unwrap_or(path);
    name.split(".ko").next().unwrap_or(name)
}

fn same_name(a: &str, b: &str) -> bool {
    a.replace('-', "_") == b.replace('-', "_")
}
