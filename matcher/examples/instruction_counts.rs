//! One frame of the fast path on a small scene, for instruction counts that a busy machine does not
//! disturb (valgrind knows no AVX-512, so this runs the AVX2 kernels):
//!
//! ```text
//! cargo build -p stspp-matcher --example instruction_counts
//! valgrind --tool=callgrind --callgrind-out-file=counts.out target/debug/examples/instruction_counts
//! callgrind_annotate counts.out | grep -E 'avx2|search_block|refit'
//! ```
//!
//! Divide by 256 x 192 pixels.

use stspp_matcher::{DisparityRange, Matcher, Method, Params, ShapeFunction, synthetic::Scene};

fn main() {
    let scene = Scene::benchmark(256, 192, 10, 20.0).render();
    let mut params = Params::new(DisparityRange { min_px: -400, max_px: 119 });
    (params.method, params.shape) = (Method::Dense, ShapeFunction::Auto);
    params.advanced.threads = Some(1);
    let mut matcher = Matcher::new(params).expect("parameters in range");
    let found = scene.with_stack(|stack| matcher.match_stack(stack)).expect("a stack of one size");
    let valid = found.disparity_px.as_slice().iter().filter(|d| !d.is_nan()).count();
    println!("{} level, {valid} valid pixels", matcher.level());
}
