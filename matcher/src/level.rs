//! The SIMD level: found once, and only ever lowered.

use std::{fmt, str::FromStr, sync::OnceLock};

use crate::Error;

/// Environment variable that lowers the level: `scalar`, `avx2`, `avx512` or `neon`.
pub const LEVEL_VARIABLE: &str = "STSPP_SIMD";

/// Which instruction set the kernels use. Every level gives the same disparities: bit-equal in the
/// integer stages, within rounding in the float ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Level {
    /// Plain Rust; the compiler's baseline.
    Scalar,
    /// AArch64 NEON, 128 bits.
    Neon,
    /// x86-64 AVX2 with FMA and POPCNT, 256 bits.
    Avx2,
    /// x86-64 AVX-512 F, BW, VL, DQ with VPOPCNTDQ, BITALG, VNNI, VBMI, VBMI2 and GFNI (Ice Lake, Zen 4
    /// and later), 512 bits.
    Avx512,
}

impl Level {
    /// All levels, lowest first.
    pub const ALL: [Level; 4] = [Level::Scalar, Level::Neon, Level::Avx2, Level::Avx512];

    /// The best level this machine can run; asked of the processor once.
    pub fn best() -> Level {
        static BEST: OnceLock<Level> = OnceLock::new();
        *BEST.get_or_init(|| {
            Level::ALL.into_iter().rev().find(|l| l.runs_here()).unwrap_or(Level::Scalar)
        })
    }

    /// Every level this machine can run, lowest first.
    pub fn available() -> impl Iterator<Item = Level> {
        Level::ALL.into_iter().filter(|l| l.runs_here())
    }

    /// The best level this machine can run that is neither above `max` nor above what
    /// [`LEVEL_VARIABLE`] asks for.
    ///
    /// # Errors
    /// [`Error::Parameter`] when the variable holds no level's name.
    pub fn choose(max: Option<Level>) -> Result<Level, Error> {
        let asked = match std::env::var(LEVEL_VARIABLE) {
            Ok(name) if !name.is_empty() => Some(name.parse::<Level>()?),
            _ => None,
        };
        let rank = [max, asked].into_iter().flatten().map(Level::rank).min().unwrap_or(u8::MAX);
        Ok(Level::available().filter(|l| l.rank() <= rank).last().unwrap_or(Level::Scalar))
    }

    /// This level, or the best one that this machine runs where it cannot run this one.
    pub fn usable(self) -> Level {
        if self.rank() <= Level::best().rank() && self.runs_here() { self } else { Level::best() }
    }

    /// Name as [`LEVEL_VARIABLE`] takes it.
    pub fn name(self) -> &'static str {
        match self {
            Level::Scalar => "scalar",
            Level::Neon => "neon",
            Level::Avx2 => "avx2",
            Level::Avx512 => "avx512",
        }
    }

    /// Order of the levels across architectures: asking for AVX2 on ARM leaves NEON on.
    fn rank(self) -> u8 {
        match self {
            Level::Scalar => 0,
            Level::Neon | Level::Avx2 => 1,
            Level::Avx512 => 2,
        }
    }

    fn runs_here(self) -> bool {
        match self {
            Level::Scalar => true,
            #[cfg(target_arch = "aarch64")]
            Level::Neon => std::arch::is_aarch64_feature_detected!("neon"),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => {
                is_x86_feature_detected!("avx2")
                    && is_x86_feature_detected!("fma")
                    && is_x86_feature_detected!("popcnt")
            }
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => {
                Level::Avx2.runs_here()
                    && is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512vpopcntdq")
                    && is_x86_feature_detected!("avx512bitalg")
                    && is_x86_feature_detected!("avx512vnni")
                    && is_x86_feature_detected!("avx512vbmi")
                    && is_x86_feature_detected!("avx512vbmi2")
                    && is_x86_feature_detected!("gfni")
            }
            #[allow(unreachable_patterns)]
            _ => false,
        }
    }
}

impl fmt::Display for Level {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Level {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self, Error> {
        Level::ALL.into_iter().find(|l| l.name().eq_ignore_ascii_case(name)).ok_or_else(|| {
            Error::Parameter {
                name: "level",
                got: name.to_owned(),
                allowed: "scalar, neon, avx2 or avx512".to_owned(),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_back() {
        for level in Level::ALL {
            assert_eq!(level.name().parse(), Ok(level));
        }
        assert!("sse9".parse::<Level>().is_err());
    }

    #[test]
    fn can_only_be_lowered() {
        assert_eq!(Level::choose(Some(Level::Scalar)), Ok(Level::Scalar));
        assert!(Level::choose(Some(Level::Avx512)).unwrap().rank() <= Level::best().rank());
        assert!(Level::available().any(|l| l == Level::best()));
    }
}
