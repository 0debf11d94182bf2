//! A dense row-major image.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};

use crate::memory::Buffer;

/// A `width` x `height` image, rows contiguous and without padding.
///
/// Large images begin at addresses that differ from one to the next where the caches tell addresses
/// apart: twenty images read side by side would otherwise drive each other's lines out, since an
/// allocation of this size begins at a page's start.
#[derive(Debug)]
pub struct Image<T> {
    width: usize,
    height: usize,
    /// The first pixel in `data`.
    from: usize,
    data: Buffer<T>,
    /// Where its memory goes when it is dropped, if anywhere.
    home: Weak<Memory<T>>,
}

/// Memory of images that were dropped.
type Memory<T> = Mutex<Vec<(usize, Buffer<T>)>>;

/// Most images whose memory a [`Spares`] keeps.
const SPARES_MAX: usize = 8;

/// Makes images whose memory comes back when they are dropped, wherever that is, for the next ones: a
/// system clears the pages of new memory, which for a map of a frame takes as long as to fill it. An image
/// that is kept keeps its memory, and so does a copy of one, which has nothing to do with this.
#[derive(Debug)]
pub struct Spares<T>(Arc<Memory<T>>);

impl<T> Default for Spares<T> {
    fn default() -> Self {
        Self(Arc::default())
    }
}

impl<T: Copy> Spares<T> {
    /// An image of any contents: what an earlier one held, or `fill`.
    pub fn image(&self, width: usize, height: usize, fill: T) -> Image<T> {
        let mut image = Image::from_memory(&self.0, width, height, fill);
        image.home = Arc::downgrade(&self.0);
        image
    }
}

/// Allocations of this many bytes begin at a page.
const LARGE: usize = 1 << 16;
/// Addresses this far apart share a set of a second-level cache.
const SPAN: usize = 1 << 17;
/// Bytes from one image's place in the span to the next's: whole lines, and by an odd number of them
/// the golden section of the span, so that places fill it evenly.
const STEP: usize = 64 * 783;

impl<T: Copy> Image<T> {
    /// An image with every pixel set to `fill`.
    pub fn new(width: usize, height: usize, fill: T) -> Self {
        let len = width * height;
        let size = size_of::<T>();
        if len * size < LARGE || !SPAN.is_multiple_of(size) {
            return Self {
                width,
                height,
                from: 0,
                data: Buffer::new(len, fill),
                home: Weak::new(),
            };
        }
        static PLACE: AtomicUsize = AtomicUsize::new(0);
        let place = PLACE.fetch_add(1, Ordering::Relaxed).wrapping_mul(STEP) % SPAN;
        let data = Buffer::new(len + SPAN / size, fill);
        // What is there or not depends on the address; no value does.
        let from = place.wrapping_sub(data.as_ptr().addr()) % SPAN / size;
        Self { width, height, from, data, home: Weak::new() }
    }

    fn from_memory(memory: &Memory<T>, width: usize, height: usize, fill: T) -> Self {
        let mut spare = memory.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |(from, data): &(usize, Buffer<T>)| data.len() >= from + width * height;
        let found = spare.iter().rposition(fits).map(|i| spare.swap_remove(i));
        drop(spare);
        match found {
            Some((from, data)) => Self { width, height, from, data, home: Weak::new() },
            None => Self::new(width, height, fill),
        }
    }

    /// Another image of this size and any contents, from the same [`Spares`] if there is one; else all
    /// of `fill`.
    pub fn sibling(&self, fill: T) -> Self {
        let Some(memory) = self.home.upgrade() else {
            return Self::new(self.width, self.height, fill);
        };
        let mut image = Self::from_memory(&memory, self.width, self.height, fill);
        image.home = Weak::clone(&self.home);
        image
    }

    /// Takes row-major `data`; `None` when its length is not `width * height`.
    pub fn from_vec(width: usize, height: usize, data: Vec<T>) -> Option<Self> {
        let fits = data.len() == width.checked_mul(height)?;
        fits.then(|| Self { width, height, from: 0, data: data.into(), home: Weak::new() })
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Row `y`.
    ///
    /// # Panics
    /// When `y` is not below the height.
    pub fn row(&self, y: usize) -> &[T] {
        &self.as_slice()[y * self.width..][..self.width]
    }

    /// Row `y`, mutable.
    ///
    /// # Panics
    /// When `y` is not below the height.
    pub fn row_mut(&mut self, y: usize) -> &mut [T] {
        let width = self.width;
        &mut self.as_mut_slice()[y * width..][..width]
    }

    /// The pixel at (`x`, `y`), or `None` outside.
    pub fn get(&self, x: usize, y: usize) -> Option<T> {
        (x < self.width && y < self.height).then(|| self.as_slice()[y * self.width + x])
    }

    /// Sets the pixel at (`x`, `y`).
    ///
    /// # Panics
    /// When the pixel is outside.
    pub fn set(&mut self, x: usize, y: usize, value: T) {
        assert!(x < self.width && y < self.height, "pixel ({x}, {y}) outside");
        let at = y * self.width + x;
        self.as_mut_slice()[at] = value;
    }

    /// All pixels, row-major.
    pub fn as_slice(&self) -> &[T] {
        &self.data[self.from..][..self.width * self.height]
    }

    /// All pixels, row-major, mutable.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        &mut self.data[self.from..][..self.width * self.height]
    }

    /// The pixels, row-major.
    pub fn into_vec(mut self) -> Vec<T> {
        let mut data = std::mem::take(&mut self.data).into_vec();
        data.truncate(self.from + self.width * self.height);
        data.drain(..self.from);
        data
    }

    /// Applies `f` to every pixel.
    pub fn map<U>(&self, f: impl FnMut(T) -> U) -> Image<U> {
        let data: Vec<U> = self.as_slice().iter().copied().map(f).collect();
        Image {
            width: self.width,
            height: self.height,
            from: 0,
            data: data.into(),
            home: Weak::new(),
        }
    }
}

impl<T: Copy> Clone for Image<T> {
    fn clone(&self) -> Self {
        let Some(&first) = self.as_slice().first() else {
            let (width, height) = (self.width, self.height);
            return Self { width, height, from: 0, data: Buffer::default(), home: Weak::new() };
        };
        let mut copy = Self::new(self.width, self.height, first);
        copy.as_mut_slice().copy_from_slice(self.as_slice());
        copy
    }

    fn clone_from(&mut self, source: &Self) {
        if (self.width, self.height) == (source.width, source.height) {
            self.as_mut_slice().copy_from_slice(source.as_slice());
        } else {
            *self = source.clone();
        }
    }
}

impl<T> Drop for Image<T> {
    fn drop(&mut self) {
        let Some(home) = self.home.upgrade() else { return };
        let mut spare = home.lock().unwrap_or_else(PoisonError::into_inner);
        if spare.len() < SPARES_MAX && !self.data.is_empty() {
            spare.push((self.from, std::mem::take(&mut self.data)));
        }
    }
}

impl<T: Copy + PartialEq> PartialEq for Image<T> {
    fn eq(&self, other: &Self) -> bool {
        (self.width, self.height) == (other.width, other.height)
            && self.as_slice() == other.as_slice()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_comes_back_when_images_are_dropped() {
        let spares = Spares::default();
        let at = |image: &Image<f32>| image.as_slice().as_ptr();
        let first = spares.image(400, 100, 1.0);
        let second = first.sibling(2.0);
        assert_eq!((first.get(9, 9), second.get(9, 9)), (Some(1.0), Some(2.0)));
        let (a, b) = (at(&first), at(&second));
        std::thread::spawn(move || drop(first)).join().unwrap();
        // What is kept, or copied, or made another thing of, is its owner's.
        let copy = second.clone();
        let again = spares.image(400, 100, 3.0);
        assert_eq!((at(&again), again.get(0, 0)), (a, Some(1.0)));
        drop(copy);
        assert_eq!(spares.image(400, 100, 4.0).get(0, 0), Some(4.0));
        drop(second);
        assert_eq!(at(&spares.image(300, 50, 5.0)), b);
        assert_eq!(again.into_vec().len(), 40_000);
        let last = spares.image(400, 500, 6.0);
        assert_eq!(last.row(100), [6.0; 400]);
        drop(spares);
        drop(last);
    }

    #[test]
    fn large_images_hold_what_small_ones_do_wherever_they_begin() {
        let mut begins = Vec::new();
        for _ in 0..9 {
            let mut image = Image::new(500, 200, 7i16);
            image.set(3, 2, 1);
            image.row_mut(199)[499] = 2;
            begins.push(image.as_slice().as_ptr().addr() % 4096);
            assert_eq!(
                (image.get(3, 2), image.get(499, 199), image.get(500, 0)),
                (Some(1), Some(2), None)
            );
            let copy = image.clone();
            assert_eq!(copy, image);
            let data = image.into_vec();
            assert_eq!(data.len(), 100_000);
            assert_eq!((data[1003], data[99_999], data[0]), (1, 2, 7));
            assert_eq!(Image::from_vec(500, 200, data).unwrap(), copy);
        }
        begins.sort_unstable();
        begins.dedup();
        assert_eq!(begins.len(), 9, "all at other places of a page");
        assert!(begins.iter().all(|b| b.is_multiple_of(64)));
    }
}
