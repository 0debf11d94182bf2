//! CPU time of the process, for stage times that a busy machine does not falsify.

/// CPU time of all threads of this process so far, in milliseconds; `None` where the system has no
/// such clock.
pub fn process_cpu_ms() -> Option<f64> {
    #[cfg(unix)]
    {
        let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
        // SAFETY: `time` is a valid, exclusive timespec for the call, which writes nothing else.
        let failed = unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &mut time) };
        #[allow(clippy::unnecessary_cast)] // 32 bits on some targets
        let ms = time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6;
        (failed == 0).then_some(ms)
    }
    #[cfg(not(unix))]
    None
}
