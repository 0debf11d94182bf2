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

/// Wall and CPU time of the steps of a job.
#[derive(Debug)]
pub struct Stopwatch {
    wall: std::time::Instant,
    cpu_ms: Option<f64>,
    steps: Vec<Step>,
}

/// Time of one step.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Step {
    /// What was done.
    pub stage: String,
    /// Wall time in milliseconds.
    pub wall_ms: f64,
    /// CPU time of all threads in milliseconds, where known.
    pub cpu_ms: Option<f64>,
}

impl Default for Stopwatch {
    fn default() -> Self {
        Self { wall: std::time::Instant::now(), cpu_ms: process_cpu_ms(), steps: Vec::new() }
    }
}

impl Stopwatch {
    /// Ends a step that began with the last one's end.
    pub fn step(&mut self, stage: impl Into<String>) {
        let (wall, cpu_ms) = (std::time::Instant::now(), process_cpu_ms());
        self.steps.push(Step {
            stage: stage.into(),
            wall_ms: (wall - self.wall).as_secs_f64() * 1e3,
            cpu_ms: cpu_ms.zip(self.cpu_ms).map(|(now, then)| now - then),
        });
        (self.wall, self.cpu_ms) = (wall, cpu_ms);
    }

    /// The steps so far.
    pub fn steps(&self) -> &[Step] {
        &self.steps
    }
}
