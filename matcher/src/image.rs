//! A dense row-major image.

use std::sync::atomic::{AtomicUsize, Ordering};

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
    data: Vec<T>,
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
            return Self { width, height, from: 0, data: vec![fill; len] };
        }
        static PLACE: AtomicUsize = AtomicUsize::new(0);
        let place = PLACE.fetch_add(1, Ordering::Relaxed).wrapping_mul(STEP) % SPAN;
        let data = vec![fill; len + SPAN / size];
        // What is there or not depends on the address; no value does.
        let from = place.wrapping_sub(data.as_ptr().addr()) % SPAN / size;
        Self { width, height, from, data }
    }

    /// Takes row-major `data`; `None` when its length is not `width * height`.
    pub fn from_vec(width: usize, height: usize, data: Vec<T>) -> Option<Self> {
        (data.len() == width.checked_mul(height)?).then_some(Self { width, height, from: 0, data })
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
        self.data.truncate(self.from + self.width * self.height);
        self.data.drain(..self.from);
        self.data
    }

    /// Applies `f` to every pixel.
    pub fn map<U>(&self, f: impl FnMut(T) -> U) -> Image<U> {
        let data = self.as_slice().iter().copied().map(f).collect();
        Image { width: self.width, height: self.height, from: 0, data }
    }
}

impl<T: Copy> Clone for Image<T> {
    fn clone(&self) -> Self {
        let Some(&first) = self.as_slice().first() else {
            return Self { width: self.width, height: self.height, from: 0, data: Vec::new() };
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
