//! The system calls that the standard library has no name for.

use std::ffi::CString;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};

fn c_string(text: &str) -> io::Result<CString> {
    CString::new(text).map_err(|_| io::Error::other("a name with a zero byte"))
}

fn check(result: libc::c_long) -> io::Result<()> {
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Mounts proc, sys, dev and two empty folders in memory.
pub fn mount_all() -> io::Result<()> {
    for (kind, at) in [
        ("proc", "/proc"),
        ("sysfs", "/sys"),
        ("devtmpfs", "/dev"),
        ("tmpfs", "/tmp"),
        ("tmpfs", "/run"),
    ] {
        std::fs::create_dir_all(at)?;
        let (kind, at) = (c_string(kind)?, c_string(at)?);
        // SAFETY: all pointers are to strings that end in zero and outlive the call; no data.
        let result =
            unsafe { libc::mount(kind.as_ptr(), at.as_ptr(), kind.as_ptr(), 0, std::ptr::null()) };
        check(result.into())?;
    }
    Ok(())
}

/// Loads a kernel module from its file.
pub fn load_module(file: &std::fs::File) -> io::Result<()> {
    let options = c_string("")?;
    // SAFETY: the descriptor is open and the options end in zero; the kernel checks the module.
    let result =
        unsafe { libc::syscall(libc::SYS_finit_module, file.as_raw_fd(), options.as_ptr(), 0) };
    match check(result) {
        Err(e) if e.raw_os_error() == Some(libc::EEXIST) => Ok(()),
        other => other,
    }
}

/// Two ends of a byte stream inside the kernel.
pub fn socket_pair() -> io::Result<(OwnedFd, OwnedFd)> {
    let mut ends = [0; 2];
    // SAFETY: `ends` has room for the two descriptors.
    let result =
        unsafe { libc::socketpair(libc::AF_UNIX, libc::SOCK_STREAM, 0, ends.as_mut_ptr()) };
    check(result.into())?;
    // SAFETY: the call succeeded, so both descriptors are open and nobody else's.
    Ok(unsafe { (OwnedFd::from_raw_fd(ends[0]), OwnedFd::from_raw_fd(ends[1])) })
}

/// Sets the machine's clock, seconds since 1970.
pub fn set_clock(seconds: i64) -> io::Result<()> {
    let time = libc::timespec { tv_sec: seconds, tv_nsec: 0 };
    // SAFETY: `time` is a valid timespec.
    check(unsafe { libc::clock_settime(libc::CLOCK_REALTIME, &time) }.into())
}

/// Ends the machine; does not return.
pub fn power_off() -> ! {
    // SAFETY: no preconditions.
    unsafe {
        libc::sync();
        libc::reboot(libc::LINUX_REBOOT_CMD_POWER_OFF);
    }
    loop {
        std::thread::park();
    }
}
