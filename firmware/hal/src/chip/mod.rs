//! What differs between the chips, chosen here and nowhere else.

#[cfg(feature = "gd32f330")]
mod f330;
#[cfg(feature = "gd32f330")]
pub use f330::*;
#[cfg(feature = "gd32f350")]
mod f350;
#[cfg(feature = "gd32f350")]
pub use f350::*;

#[cfg(all(target_os = "none", not(any(feature = "gd32f330", feature = "gd32f350"))))]
compile_error!("choose a chip: feature `gd32f330` or `gd32f350`");
#[cfg(all(feature = "gd32f330", feature = "gd32f350"))]
compile_error!("choose one chip only: feature `gd32f330` or `gd32f350`");
