//! The machine: kernel, modules, udev rule.

use std::fs;
use std::path::Path;

use super::Check;

/// The rule as it is shipped.
const RULE: &str = "70-stspp.rules";

/// Folders that udev reads, the administrator's first.
const RULE_FOLDERS: [&str; 3] = ["/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d"];

/// All checks of the machine.
pub fn checks() -> Vec<Check> {
    vec![kernel(), usb_files(), module("uvcvideo", "cameras"), udev_rule(), usbfs_memory()]
}

fn text(path: &str) -> Option<String> {
    fs::read_to_string(path).ok().map(|text| text.trim().to_owned())
}

fn kernel() -> Check {
    let Some(release) = text("/proc/sys/kernel/osrelease") else {
        return Check::bad(
            "kernel",
            "no Linux kernel",
            "cameras are read by V4L2, which is Linux's",
        );
    };
    let mut numbers = release.split(['.', '-']).map(|n| n.parse::<u32>().unwrap_or(0));
    let version = (numbers.next().unwrap_or(0), numbers.next().unwrap_or(0));
    if version < (4, 16) {
        let remedy = "4.16 or newer tells the cameras' own clock, which pairs frames more surely";
        return Check::poor("kernel", release, remedy);
    }
    Check::good("kernel", release)
}

fn usb_files() -> Check {
    if Path::new("/dev/bus/usb").exists() {
        Check::good("USB files", "/dev/bus/usb")
    } else {
        let remedy = "in a container, pass it through: docker run --device /dev/bus/usb";
        Check::bad("USB files", "no /dev/bus/usb", remedy)
    }
}

fn module(name: &'static str, what: &str) -> Check {
    let loaded = Path::new("/sys/module").join(name).exists();
    if loaded {
        return Check::good("kernel module", format!("{name} ({what})"));
    }
    let release = text("/proc/sys/kernel/osrelease").unwrap_or_default();
    let built_in = text(&format!("/lib/modules/{release}/modules.builtin"))
        .is_some_and(|list| list.contains(&format!("/{name}.ko")));
    if built_in {
        return Check::good("kernel module", format!("{name} ({what}, built in)"));
    }
    let found = format!("{name} is not loaded ({what})");
    Check::poor("kernel module", found, format!("it comes with the first camera; modprobe {name}"))
}

fn udev_rule() -> Check {
    let installed = RULE_FOLDERS.iter().map(|f| Path::new(f).join(RULE)).find(|p| p.exists());
    match installed {
        Some(path) => Check::good("udev rule", path.display().to_string()),
        None if fs::metadata("/proc/self").is_ok_and(|m| is_root(&m)) => {
            Check::good("udev rule", "not installed; root needs none")
        }
        None => Check::poor(
            "udev rule",
            "not installed",
            format!(
                "sudo cp udev/{RULE} /etc/udev/rules.d/ && sudo udevadm control --reload && \
                     sudo udevadm trigger, then plug the sensor in again"
            ),
        ),
    }
}

fn is_root(metadata: &fs::Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    metadata.uid() == 0
}

fn usbfs_memory() -> Check {
    const NAME: &str = "usbfs memory";
    match text("/sys/module/usbcore/parameters/usbfs_memory_mb").and_then(|t| t.parse::<u32>().ok())
    {
        Some(0) => Check::good(NAME, "unlimited"),
        // The control link needs a few kilobytes; the cameras' pictures do not pass here.
        Some(mb @ 1..) => Check::good(NAME, format!("{mb} MB")),
        None => Check::poor(NAME, "not known", "the usbcore module shows no usbfs_memory_mb"),
    }
}
