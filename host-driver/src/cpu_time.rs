//! Wall and CPU time of the steps of a job.

pub use stspp_matcher::cpu_time::process_cpu_ms;

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
