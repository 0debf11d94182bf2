//! The fast path takes no memory per frame once it has seen one, and less than the limit at all.

use std::{
    alloc::{GlobalAlloc, Layout, System},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering::Relaxed},
    },
};

use stspp_matcher::{
    DisparityRange, Image, Matched, Matcher, Method, Params, Sample, ShapeFunction, StereoStack,
    synthetic::{Random, Scene},
};

/// Counts what is asked of the system's allocator.
struct Counting;

static TAKEN: AtomicUsize = AtomicUsize::new(0);
static HELD: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call is passed on as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        TAKEN.fetch_add(layout.size(), Relaxed);
        PEAK.fetch_max(HELD.fetch_add(layout.size(), Relaxed) + layout.size(), Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The counters are the process's: one test at a time.
static ALONE: Mutex<()> = Mutex::new(());

/// What the thread pool's queues may take in a frame: they grow by blocks now and then.
const QUEUES: usize = 16 << 10;
/// Bytes a pixel that the matcher holds at most, in maps and descriptors: 125 MiB in a full frame.
const BYTES_PER_PIXEL: usize = 100;

#[test]
fn no_memory_is_taken_after_the_first_frame() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    for (shape, frames, motion, settle) in [
        (ShapeFunction::First, 10, false, false),
        (ShapeFunction::Auto, 5, false, false),
        (ShapeFunction::Auto, 10, true, false),
        (ShapeFunction::Auto, 10, true, true),
    ] {
        let scene = Scene::benchmark(480, 200, frames, 20.0).render();
        let times: Vec<f64> = (0..frames).map(|k| k as f64 / 30.0).collect();
        let mut params = Params::new(DisparityRange { min_px: -150, max_px: 80 });
        (params.method, params.shape, params.motion) = (Method::Dense, shape, motion);
        params.advanced.settle_steps = settle;
        // A thread's buffers are made when it first gets work, which with several is chance.
        params.advanced.threads = Some(1);
        let before = HELD.load(Relaxed);
        PEAK.store(before, Relaxed);
        let mut matcher = Matcher::new(params).unwrap();
        let mut out = Matched::default();
        scene.with_stack(|stack| {
            let stack = StereoStack { times_s: Some(&times), ..*stack };
            for frame in 0..5 {
                let taken = TAKEN.load(Relaxed);
                matcher.match_into(&stack, &mut out).unwrap();
                let taken = TAKEN.load(Relaxed) - taken;
                println!(
                    "{shape:?}, {frames} frames, motion {motion}, frame {frame}: {taken} bytes"
                );
                assert!(frame < 2 || taken <= QUEUES, "{shape:?} frame {frame}: {taken} bytes");
            }
        });
        let valid = out.disparity_px.as_slice().iter().filter(|d| !d.is_nan()).count();
        assert!(valid > 60_000, "{valid} pixels");
        let peak = PEAK.load(Relaxed) - before;
        println!("peak {:.1} MiB, {} bytes a pixel", peak as f64 / 1048576.0, peak / (480 * 200));
        // A thread's tile does not grow with the image's height.
        assert!(peak <= BYTES_PER_PIXEL * 480 * 200 + (16 << 20), "{peak} bytes");
    }
}

/// Images of the sensor's size and ten frames: what the matcher holds, and with the window's images.
#[test]
fn a_full_frame_stays_below_the_limit() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    const MIB: f64 = 1_048_576.0;
    let (width, height, frames) = (1280, 1024, 10);
    let mut random = Random::new(3);
    // Memory depends on sizes alone: one picture without noise serves for all.
    let image = Image::new(width, height, 0).map(|_: Sample| (random.bits() % 8000) as Sample);
    let images = vec![&image; frames];
    let times: Vec<f64> = (0..frames).map(|k| k as f64 / 30.0).collect();
    let mut params = Params::new(DisparityRange { min_px: -400, max_px: 119 });
    (params.method, params.shape) = (Method::Dense, ShapeFunction::Auto);
    params.advanced.threads = Some(2);
    let before = HELD.load(Relaxed);
    PEAK.store(before, Relaxed);
    let mut matcher = Matcher::new(params).unwrap();
    let mut out = Matched::default();
    let stack = StereoStack { times_s: Some(&times), ..StereoStack::new(&images, &images) };
    matcher.match_into(&stack, &mut out).unwrap();
    let peak = (PEAK.load(Relaxed) - before) as f64 / MIB;
    let window = (2 * frames * width * height * size_of::<Sample>()) as f64 / MIB;
    println!("full frame: matcher {peak:.0} MiB, with its window {:.0} MiB", peak + window);
    assert!(peak + window < 350.0, "{peak} + {window} MiB");
}
