//! From cells of half a pixel to pixels: the lens' point spread and the pixel's aperture.

use rayon::prelude::*;

use super::gbuffer::CELLS_PER_PIXEL;

/// Weights of the cells around a pixel, from `-reach` to `reach - 1` relative to its first cell's
/// right neighbour: the response of a square pixel behind a Gaussian lens, along one axis.
#[derive(Debug, Clone)]
pub(crate) struct Response {
    pub weights: Vec<f32>,
}

impl Response {
    pub fn new(blur_sigma_px: f64) -> Self {
        let spacing = 1.0 / CELLS_PER_PIXEL as f64;
        let reach = ((4.0 * blur_sigma_px + 0.5) / spacing).ceil() as usize;
        let mut weights: Vec<f64> = (0..2 * reach)
            .map(|k| {
                let offset = (k as f64 - reach as f64 + 0.5) * spacing;
                pixel_response(offset, blur_sigma_px)
            })
            .collect();
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= sum);
        Self { weights: weights.into_iter().map(|w| w as f32).collect() }
    }

    /// Cells needed on each side of the image.
    pub fn margin(&self) -> usize {
        self.weights.len() / 2 - CELLS_PER_PIXEL / 2
    }

    /// Sums cells into an image of `width` columns.
    pub fn apply(&self, cells: &[f32], columns: usize, width: usize, height: usize) -> Vec<f32> {
        let mut lines = vec![0.0_f32; cells.len() / columns * width];
        lines.par_chunks_mut(width).zip(cells.par_chunks(columns)).for_each(|(line, cells)| {
            for (u, out) in line.iter_mut().enumerate() {
                let window = &cells[CELLS_PER_PIXEL * u..][..self.weights.len()];
                *out = window.iter().zip(&self.weights).map(|(c, w)| c * w).sum();
            }
        });
        let mut image = vec![0.0_f32; width * height];
        image.par_chunks_mut(width).enumerate().for_each(|(v, out)| {
            for (k, weight) in self.weights.iter().enumerate() {
                let line = &lines[(CELLS_PER_PIXEL * v + k) * width..][..width];
                for (o, l) in out.iter_mut().zip(line) {
                    *o += weight * l;
                }
            }
        });
        image
    }
}

/// Gaussian convolved with the unit box, up to a constant factor.
fn pixel_response(offset: f64, sigma: f64) -> f64 {
    if sigma < 1e-3 {
        return if offset.abs() < 0.5 { 1.0 } else { 0.0 };
    }
    const STEPS: usize = 200;
    (0..STEPS)
        .map(|i| {
            let x = offset + (i as f64 + 0.5) / STEPS as f64 - 0.5;
            (-0.5 * (x / sigma).powi(2)).exp()
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_response_has_the_variance_of_lens_and_pixel() {
        for sigma in [0.0, 0.4, 0.6, 1.0] {
            let response = Response::new(sigma);
            let reach = response.weights.len() as f64 / 2.0;
            let variance: f64 = response
                .weights
                .iter()
                .enumerate()
                .map(|(k, &w)| f64::from(w) * ((k as f64 - reach + 0.5) / 2.0).powi(2))
                .sum();
            // A square pixel of side 1 adds 1/12; cells of side 1/2 are themselves points, which
            // takes away 1/48 when nothing else blurs.
            let expected = if sigma == 0.0 { 1.0 / 16.0 } else { sigma * sigma + 1.0 / 12.0 };
            assert!((variance - expected).abs() < 0.004, "{sigma}: {variance} {expected}");
        }
    }

    #[test]
    fn an_even_field_stays_even_up_to_the_border() {
        let response = Response::new(0.6);
        let margin = response.margin();
        let (columns, rows) = (2 * 8 + 2 * margin, 2 * 5 + 2 * margin);
        let image = response.apply(&vec![3.0; columns * rows], columns, 8, 5);
        assert_eq!(image.len(), 40);
        assert!(image.iter().all(|v| (v - 3.0).abs() < 1e-5));
    }
}
