//! The whole match, stage by stage.

use crate::{Error, Level, Matched, Method, Params, StereoStack, parallel::Pool};

/// Matches stereo stacks; keeps its buffers between frames.
///
/// ```
/// use stspp_matcher::{DisparityRange, Matcher, Params};
/// let matcher = Matcher::new(Params::new(DisparityRange { min_px: -400, max_px: 119 }))?;
/// assert!(matcher.threads() >= 1);
/// # Ok::<(), stspp_matcher::Error>(())
/// ```
#[derive(Debug)]
pub struct Matcher {
    params: Params,
    level: Level,
    pool: Pool,
}

impl Matcher {
    /// A matcher with the given parameters.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a parameter outside its range.
    pub fn new(params: Params) -> Result<Self, Error> {
        params.check()?;
        let level = Level::choose(params.advanced.level_max)?;
        let pool = Pool::new(params.advanced.threads)?;
        Ok(Self { params, level, pool })
    }

    /// The parameters in use.
    pub fn params(&self) -> &Params {
        &self.params
    }

    /// The SIMD level in use.
    pub fn level(&self) -> Level {
        self.level
    }

    /// Number of threads the stages are spread over.
    pub fn threads(&self) -> usize {
        self.pool.threads()
    }

    /// Disparity and similarity of one stack.
    ///
    /// # Errors
    /// [`Error::FrameCount`] and [`Error::Shape`] for a stack that cannot be matched.
    pub fn match_stack(&mut self, stack: &StereoStack<'_>) -> Result<Matched, Error> {
        stack.check()?;
        let pool = self.pool.clone();
        pool.install(|| match self.params.method {
            Method::Parabola | Method::IcGn | Method::Dense => Err(Error::Parameter {
                name: "method",
                got: format!("{:?}", self.params.method),
                allowed: "a method that is built in (none yet)".to_owned(),
            }),
        })
    }
}
