//! Vectors of `f32` with the same operations at every SIMD level, so that a float kernel is written
//! once and compiled per level by `dispatch!`.

pub(crate) mod scalar;

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;

/// Values that a row buffer holds beyond its last pixel at least, so that whole vectors fit.
pub(crate) const WIDEST: usize = 16;

/// A vector of [`Lanes::COUNT`] `f32`.
///
/// # Safety of implementations
/// The methods may use the level's instructions: call them only from a function that
/// [`crate::lanes::dispatch`] compiled for the level.
pub(crate) trait Lanes: Copy {
    /// Outcome of a comparison, per lane.
    type Mask: Copy;
    /// Number of lanes; divides [`WIDEST`].
    const COUNT: usize;

    /// All lanes equal.
    fn splat(value: f32) -> Self;
    /// Reads lanes from `from`.
    ///
    /// # Safety
    /// [`Lanes::COUNT`] values are readable at `from`; no alignment needed.
    unsafe fn load(from: *const f32) -> Self;
    /// Writes lanes to `to`.
    ///
    /// # Safety
    /// [`Lanes::COUNT`] values are writable at `to`; no alignment needed.
    unsafe fn store(self, to: *mut f32);
    /// Sum.
    fn add(self, other: Self) -> Self;
    /// Difference.
    fn sub(self, other: Self) -> Self;
    /// Product.
    fn mul(self, other: Self) -> Self;
    /// 1 / self, to within two units in the last place.
    fn reciprocal(self) -> Self;
    /// 1 / sqrt(self) of a positive number whose square is finite and not denormal, to within four units
    /// in the last place.
    fn reciprocal_sqrt(self) -> Self;
    /// self * factor + addend, fused where the level can.
    fn mul_add(self, factor: Self, addend: Self) -> Self;
    /// addend - self * factor, fused where the level can.
    fn neg_mul_add(self, factor: Self, addend: Self) -> Self;
    /// Magnitude.
    fn abs(self) -> Self;
    /// Whether self < other; false for NaN.
    fn lt(self, other: Self) -> Self::Mask;
    /// Both.
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// `yes` where the mask holds, else `no`.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// Whether any lane of the mask holds.
    fn any(mask: Self::Mask) -> bool;
    /// Whether [`Lanes::ahead`] is there, and faster than a load across two cache lines.
    const AHEAD: bool = false;
    /// The lanes from lane K on, and behind them the first of `next`.
    fn ahead<const K: i32>(self, _next: Self) -> Self {
        unreachable!("asked only of levels that have it")
    }
}

/// Calls a function generic over [`Lanes`] at a level: `dispatch!(level, kernel(a: &[f32], n: usize))`
/// compiles one copy per level, with that level's instructions enabled.
macro_rules! dispatch {
    ($level:expr, $kernel:ident($($arg:ident : $ty:ty = $value:expr),* $(,)?)) => {{
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma,popcnt,avx512f,avx512bw,avx512vl,avx512dq")]
        #[allow(clippy::too_many_arguments)]
        fn avx512($($arg: $ty),*) {
            $kernel::<crate::lanes::avx512::F32x16>($($arg),*)
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma,popcnt")]
        #[allow(clippy::too_many_arguments)]
        fn avx2($($arg: $ty),*) {
            $kernel::<crate::lanes::avx2::F32x8>($($arg),*)
        }
        match $level {
            #[cfg(target_arch = "x86_64")]
            // SAFETY: a trusted level was found on this processor (Level::usable).
            crate::Level::Avx512 => unsafe { avx512($($value),*) },
            #[cfg(target_arch = "x86_64")]
            // SAFETY: as above.
            crate::Level::Avx2 => unsafe { avx2($($value),*) },
            #[cfg(target_arch = "aarch64")]
            crate::Level::Neon => $kernel::<crate::lanes::neon::F32x4>($($value),*),
            _ => $kernel::<crate::lanes::scalar::Plain>($($value),*),
        }
    }};
}
pub(crate) use dispatch;

/// Compiles a loop over slices per level: the compiler vectorises it with the level's registers.
macro_rules! vectorised {
    ($level:expr, $kernel:ident($($arg:ident : $ty:ty = $value:expr),* $(,)?)) => {{
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma,popcnt,avx512f,avx512bw,avx512vl,avx512dq")]
        #[allow(clippy::too_many_arguments)]
        fn avx512($($arg: $ty),*) {
            $kernel($($arg),*)
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma,popcnt")]
        #[allow(clippy::too_many_arguments)]
        fn avx2($($arg: $ty),*) {
            $kernel($($arg),*)
        }
        match $level {
            #[cfg(target_arch = "x86_64")]
            // SAFETY: a trusted level was found on this processor.
            crate::Level::Avx512 => unsafe { avx512($($value),*) },
            #[cfg(target_arch = "x86_64")]
            // SAFETY: as above.
            crate::Level::Avx2 => unsafe { avx2($($value),*) },
            _ => $kernel($($value),*),
        }
    }};
}
pub(crate) use vectorised;
