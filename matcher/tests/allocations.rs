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

/// A scene of which much is lit and not found, so that fewer frames are tried: rows whose right images
/// belong to another scene.
#[test]
fn no_memory_is_taken_where_much_is_lost_either() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let frames = 10;
    // 200 rows: the last band of those that are tried is not whole.
    let scene = Scene::benchmark(480, 200, frames, 20.0).render();
    let mut other = Scene::benchmark(480, 200, frames, 20.0);
    other.seed += 1;
    let other = other.render();
    let times: Vec<f64> = (0..frames).map(|k| k as f64 / 30.0).collect();
    for lost in [40..110, 110..200] {
        let right: Vec<Image<Sample>> = scene
            .right
            .iter()
            .zip(&other.right)
            .map(|(own, other)| {
                let mut image = own.clone();
                lost.clone().for_each(|y| image.row_mut(y).copy_from_slice(other.row(y)));
                image
            })
            .collect();
        let (left, right): (Vec<_>, Vec<_>) = (scene.left.iter().collect(), right.iter().collect());
        let stack = StereoStack { times_s: Some(&times), ..StereoStack::new(&left, &right) };
        let mut params = Params::new(DisparityRange { min_px: -150, max_px: 80 });
        (params.method, params.shape) = (Method::Dense, ShapeFunction::First);
        params.advanced.threads = Some(1);
        let mut matcher = Matcher::new(params).unwrap();
        let mut out = Matched::default();
        for frame in 0..4 {
            let taken = TAKEN.load(Relaxed);
            matcher.match_into(&stack, &mut out).unwrap();
            let taken = TAKEN.load(Relaxed) - taken;
            println!("{lost:?} lost, frame {frame}: {taken} bytes");
            assert!(frame < 2 || taken <= QUEUES, "frame {frame}: {taken} bytes");
        }
        let valid = |rows: std::ops::Range<usize>| -> usize {
            let row = |y| out.disparity_px.row(y).iter().filter(|d| !d.is_nan()).count();
            rows.map(row).sum()
        };
        let found = valid(0..200) as f64 / (200.0 * 480.0);
        println!("{lost:?} lost: {found} found, {} in the first rows", valid(0..30));
        assert!(found < 0.8 && (lost.start > 40 || valid(0..30) > 8_000));
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
