//! The whole match, stage by stage.

use std::time::Instant;

use crate::{
    Error, Image, Level, Matched, Method, Params, ShapeFunction, Spares, StageTime, StereoStack,
    census::{PaddedStack, Side},
    check,
    cpu_time::process_cpu_ms,
    dense::{DenseMaps, order::OrderChoice},
    fast::Fast,
    icgn::{field::Field, guess::CoarseMap, prepare::Prepared},
    parallel::Pool,
    regions::Regions,
    search::{self, Coarse},
};

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
    left: PaddedStack,
    right: PaddedStack,
    prepared: Prepared,
    map: CoarseMap,
    field: Field,
    regions: Regions,
    order: OrderChoice,
    /// Made by the first frame that needs it.
    fast: Option<Fast>,
    /// Memory of results that their reader is done with.
    spare_maps: Spares<f32>,
    spare_brightness: Spares<u8>,
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
        Ok(Self {
            params,
            level,
            pool,
            left: PaddedStack::default(),
            right: PaddedStack::default(),
            prepared: Prepared::default(),
            map: CoarseMap::default(),
            field: Field::default(),
            regions: Regions::default(),
            order: OrderChoice::default(),
            fast: None,
            spare_maps: Spares::default(),
            spare_brightness: Spares::default(),
        })
    }

    /// The parameters in use.
    pub fn params(&self) -> &Params {
        &self.params
    }

    /// Changes the order of the shape function, from the next match on.
    pub fn set_shape(&mut self, shape: ShapeFunction) {
        self.params.shape = shape;
        if let Some(fast) = &mut self.fast {
            fast.set_shape(shape);
        }
    }

    /// The SIMD level in use.
    pub fn level(&self) -> Level {
        self.level
    }

    /// Where the stages run: what else a frame takes can run there, too ([`Pool::frame`]).
    pub fn pool(&self) -> &Pool {
        &self.pool
    }

    /// Number of threads the stages are spread over.
    pub fn threads(&self) -> usize {
        self.pool.threads()
    }

    /// Disparity and similarity of one stack. With [`Method::Dense`], the memory of earlier results that
    /// were dropped is used again.
    ///
    /// # Errors
    /// [`Error::FrameCount`] and [`Error::Shape`] for a stack that cannot be matched.
    pub fn match_stack(&mut self, stack: &StereoStack<'_>) -> Result<Matched, Error> {
        stack.check()?;
        let mut out = Matched::default();
        if self.params.method == Method::Dense {
            let (width, height) = (stack.width(), stack.height());
            out.disparity_px = self.spare_maps.image(width, height, f32::NAN);
            out.zncc = self.spare_maps.image(width, height, f32::NAN);
            if self.params.motion && stack.times_s.is_some() {
                out.rate_px_per_s = Some(self.spare_maps.image(width, height, 0.0));
            }
            out.brightness = Some(self.spare_brightness.image(width, height, 0));
        }
        self.match_into(stack, &mut out)?;
        Ok(out)
    }

    /// As [`Self::match_stack`], in place of what `out` holds: with [`Method::Dense`] and stacks of
    /// one size, a loop that keeps its result takes no new memory from the second frame on.
    ///
    /// # Errors
    /// As there; `out` is then as it was.
    pub fn match_into(&mut self, stack: &StereoStack<'_>, out: &mut Matched) -> Result<(), Error> {
        stack.check()?;
        let pool = self.pool.clone();
        match self.params.method {
            Method::Parabola => *out = pool.install(|| self.parabola(stack)),
            Method::IcGn => *out = pool.install(|| self.icgn(stack)),
            Method::Dense => pool.frame(|| self.dense(stack, out)),
        }
        Ok(())
    }

    /// The coarse search and its checks.
    fn coarse(&mut self, stack: &StereoStack<'_>, clock: &mut Clock) -> Coarse {
        self.left.fill(Side::Left, stack.left, stack.left_mask);
        self.right.fill(Side::Right, stack.right, stack.right_mask);
        clock.stage("pad");
        let mut coarse = search::search(&self.left, &self.right, &self.params, self.level);
        clock.stage("search");
        let searched = coarse.disparity_px.clone();
        check::median_3x3(&searched, &mut coarse.disparity_px);
        if let Some(mask) = stack.left_mask {
            // The median closes gaps, also those that the mask makes.
            let pixels = coarse.disparity_px.as_mut_slice().iter_mut().zip(mask.as_slice());
            pixels.filter(|(_, m)| **m == 0).for_each(|(d, _)| *d = f32::NAN);
        }
        self.regions.remove(&mut coarse.disparity_px, self.params.advanced.region_min);
        clock.stage("check");
        coarse
    }

    /// Descriptors, their search, and dense least squares.
    fn dense(&mut self, stack: &StereoStack<'_>, out: &mut Matched) {
        let mut clock = Clock::start(std::mem::take(&mut out.stages));
        let Self { fast, level, params, .. } = self;
        let fast = fast.get_or_insert_with(|| Fast::new(*level, params));
        fast.run(stack, out, |stage| clock.stage(stage));
        out.at_newest = params.motion;
        out.stages = clock.stages;
    }

    fn parabola(&mut self, stack: &StereoStack<'_>) -> Matched {
        let mut clock = Clock::start(Vec::new());
        let coarse = self.coarse(stack, &mut clock);
        let zncc = Image::new(stack.width(), stack.height(), f32::NAN);
        Matched {
            disparity_px: coarse.disparity_px,
            zncc,
            at_newest: false,
            rate_px_per_s: None,
            brightness: None,
            stages: clock.stages,
        }
    }

    /// The coarse search, refined by Stereo-DIC.
    fn icgn(&mut self, stack: &StereoStack<'_>) -> Matched {
        let mut clock = Clock::start(Vec::new());
        let coarse = self.coarse(stack, &mut clock);
        self.prepared.fill(stack, self.params.advanced.interpolation);
        self.map.fill(&coarse.disparity_px);
        clock.stage("prepare");
        let Self { field, prepared, map, order, params, level, regions, .. } = self;
        field.refine(prepared, map, stack, params, *level);
        clock.stage("icgn");
        let (mut disparity_px, mut zncc) = (field.disparity_px(), field.zncc());
        if params.shape == ShapeFunction::Auto {
            let first_px = field.first_order_px(prepared, map, params, *level);
            let brightness = Image::new(0, 0, 0);
            let second_px = disparity_px.clone();
            let mut maps = DenseMaps { first_px, second_px, zncc, brightness };
            order.choose(level.usable(), params.zncc_min, &mut maps, &mut disparity_px);
            zncc = maps.zncc;
            clock.stage("order");
        }
        regions.remove(&mut disparity_px, params.advanced.region_min);
        for (z, d) in zncc.as_mut_slice().iter_mut().zip(disparity_px.as_slice()) {
            *z = if d.is_nan() { f32::NAN } else { *z };
        }
        clock.stage("outlier");
        Matched {
            disparity_px,
            zncc,
            at_newest: false,
            rate_px_per_s: None,
            brightness: None,
            stages: clock.stages,
        }
    }
}

/// Times the stages of a frame.
struct Clock {
    last: Instant,
    cpu_ms: Option<f64>,
    stages: Vec<StageTime>,
}

impl Clock {
    /// Times a frame, in the memory of another one's times.
    fn start(mut stages: Vec<StageTime>) -> Self {
        stages.clear();
        Self { last: Instant::now(), cpu_ms: process_cpu_ms(), stages }
    }

    fn stage(&mut self, stage: &'static str) {
        let (now, now_ms) = (Instant::now(), process_cpu_ms());
        let wall_ms = (now - self.last).as_secs_f64() * 1e3;
        let cpu_ms = now_ms.zip(self.cpu_ms).map(|(now, before)| now - before);
        self.stages.push(StageTime { stage, wall_ms, cpu_ms });
        (self.last, self.cpu_ms) = (now, now_ms);
    }
}
