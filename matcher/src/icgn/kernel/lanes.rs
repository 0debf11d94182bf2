//! The vector operations that the IC-GN kernels are written in.

/// A vector of `N` f32 lanes, one a frame. Implementations are called only from functions compiled for
/// their instructions.
pub(super) trait Lanes: Copy {
    /// Number of lanes; divides 16.
    const N: usize;

    fn splat(value: f32) -> Self;

    /// # Safety
    /// `N` values are readable at `from`.
    unsafe fn load(from: *const f32) -> Self;

    /// # Safety
    /// `N` values are writable at `to`.
    unsafe fn store(self, to: *mut f32);

    /// Stores whole numbers, which the lanes hold.
    ///
    /// # Safety
    /// `N` values are writable at `to`, and the lanes are within the range of i32.
    unsafe fn store_whole(self, to: *mut i32);

    /// Rounds down; the lanes are within the range of i32.
    fn floor(self) -> Self;

    fn sub(self, other: Self) -> Self;

    fn min(self, other: Self) -> Self;

    fn max(self, other: Self) -> Self;

    fn add(self, other: Self) -> Self;

    fn mul(self, other: Self) -> Self;

    /// `self * factor + term`; one rounding where the machine has it.
    fn mul_add(self, factor: Self, term: Self) -> Self;

    /// Sum of the lanes.
    fn sum(self) -> f32;
}
