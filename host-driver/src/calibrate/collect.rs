//! Which frames of a live sensor to keep: the board is seen by both cameras, is held still, and is
//! somewhere new.

use nalgebra::Vector2;

use super::Board;
use super::detect::Problem;
use super::images::{Found, PairDetections, detect_pair};
use super::observations::Sighting;
use super::zhang::POINTS_MIN;
use crate::recording::StereoPair;

/// Motion of the points between two frames, root mean square in px, up to which a board is still.
const STILL_PX: f64 = 0.35;
/// Mean distance of the points from those of every kept frame, in px, from which a place is new.
const NEW_PX: f64 = 50.0;

/// What became of a frame.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Offer {
    /// It is kept.
    Kept,
    /// The board moves.
    Moving,
    /// The board is where it was in a frame that is kept.
    Known,
    /// One camera does not see the board, or too little of it.
    NotSeen([Option<Problem>; 2]),
}

/// Collects frames.
#[derive(Debug, Clone)]
pub struct Collector {
    board: Board,
    last: Option<Vec<Sighting>>,
    kept: Vec<Vec<Sighting>>,
    found: Option<Found>,
}

impl Collector {
    /// Nothing is kept yet.
    pub fn new(board: &Board) -> Self {
        Self { board: *board, last: None, kept: Vec::new(), found: None }
    }

    /// Number of kept frames.
    pub fn len(&self) -> usize {
        self.kept.len()
    }

    /// Whether nothing is kept yet.
    pub fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }

    /// What was found in the kept frames; `None` when there are none.
    pub fn found(&self) -> Option<&Found> {
        self.found.as_ref()
    }

    /// Takes a frame, or not.
    pub fn offer(&mut self, pair: &StereoPair) -> Offer {
        let detections = detect_pair(pair, &self.board);
        let size = [pair.left.width(), pair.left.height()];
        self.offer_detections(size, detections)
    }

    fn offer_detections(&mut self, size: [usize; 2], detections: PairDetections) -> Offer {
        let points = match &detections {
            [Ok(l), Ok(r)] if l.sightings.len().min(r.sightings.len()) >= POINTS_MIN => {
                l.sightings.clone()
            }
            _ => {
                self.last = None;
                return Offer::NotSeen(detections.map(Result::err));
            }
        };
        let before = self.last.replace(points.clone());
        // Frames overlap in time with nothing: two equal ones in a row show a board at rest.
        if !before.is_some_and(|before| distance(&before, &points) <= STILL_PX) {
            return Offer::Moving;
        }
        if self.kept.iter().any(|kept| distance(kept, &points) < NEW_PX) {
            return Offer::Known;
        }
        self.kept.push(points);
        let found = self.found.get_or_insert_with(|| Found::new(&self.board, size));
        found.push(format!("{:02}", self.kept.len() - 1), detections);
        Offer::Kept
    }
}

/// Root mean square distance of the points that both have; infinite when they share none.
fn distance(a: &[Sighting], b: &[Sighting]) -> f64 {
    let differences: Vec<Vector2<f64>> = a
        .iter()
        .filter_map(|a| Some(a.pixel - b.iter().find(|b| b.point == a.point)?.pixel))
        .collect();
    if differences.is_empty() {
        return f64::INFINITY;
    }
    (differences.iter().map(Vector2::norm_squared).sum::<f64>() / differences.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibrate::detect::{Detection, Quality};

    #[test]
    fn a_board_is_kept_once_where_it_rests() {
        let mut collector = Collector::new(&Board::default());
        let mut offer = |x: f64| {
            let seen = |shift: f64| {
                let sightings = (0..12)
                    .map(|point| Sighting {
                        point,
                        pixel: Vector2::new(x + shift + 20.0 * point as f64, 100.0),
                    })
                    .collect();
                Ok(Detection { sightings, quality: Quality::default() })
            };
            collector.offer_detections([1280, 1024], [seen(0.0), seen(-50.0)])
        };
        assert_eq!(offer(100.0), Offer::Moving);
        assert_eq!(offer(100.1), Offer::Kept);
        assert_eq!(offer(100.0), Offer::Known);
        assert_eq!(offer(180.0), Offer::Moving);
        assert_eq!(offer(180.2), Offer::Kept);
        let blind = [Err(Problem::Mirrored), Err(Problem::NoBoard { corners: 3 })];
        assert!(matches!(
            collector.offer_detections([1280, 1024], blind),
            Offer::NotSeen([Some(Problem::Mirrored), Some(_)])
        ));
        assert_eq!(collector.len(), 2);
    }
}
