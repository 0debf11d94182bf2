//! Boards to print, as SVG or PDF, true to size.
//!
//! Both are drawn from one list of black shapes in millimetres. A ruler below the print shows whether
//! the printer scaled it.

use std::fmt::Write as _;

use super::Board;
use super::board::Pattern;

/// White around the print, in mm, that detection needs.
const MARGIN_MM: f64 = 5.0;
/// Room for the ruler and the text below the print.
const FOOT_MM: f64 = 6.0;
/// Millimetres of a point, the unit of PDF.
const MM_PER_PT: f64 = 25.4 / 72.0;
/// Handle length of a quarter circle as a Bezier curve, in radii; off by 0.03 % at most.
const QUARTER: f64 = 0.552_284_75;

/// Sheets of paper, lying: name, width and height in mm.
pub const PAPERS: [(&str, [f64; 2]); 5] = [
    ("A4", [297.0, 210.0]),
    ("A3", [420.0, 297.0]),
    ("A2", [594.0, 420.0]),
    ("A1", [841.0, 594.0]),
    ("A0", [1189.0, 841.0]),
];

/// A board that no sheet is large enough for.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "a print of {:.0} x {:.0} mm does not fit on {paper} ({:.0} x {:.0} mm) with its margin",
    size_mm[0], size_mm[1], paper_mm[0], paper_mm[1]
)]
pub struct PaperError {
    /// Size of the print.
    pub size_mm: [f64; 2],
    /// The sheet.
    pub paper: &'static str,
    /// Its size.
    pub paper_mm: [f64; 2],
}

/// A board on its sheet.
#[derive(Debug, Clone)]
pub struct Sheet {
    board: Board,
    /// Name of the paper.
    pub paper: &'static str,
    size_mm: [f64; 2],
    shapes: Vec<Shape>,
    origin_mm: [f64; 2],
}

/// Something to fill, in mm from the sheet's upper left corner.
#[derive(Debug, Clone, Copy)]
enum Shape {
    Rectangle { x: f64, y: f64, width: f64, height: f64 },
    Disc { x: f64, y: f64, radius: f64, hole: Option<f64> },
}

impl Sheet {
    /// Puts a board on the smallest sheet that it fits on, or on the named one.
    ///
    /// # Errors
    /// When it does not fit.
    pub fn new(board: &Board, paper: Option<&'static str>) -> Result<Self, PaperError> {
        let print_mm = board.size_m().map(|m| 1e3 * m);
        let fits = |[width, height]: [f64; 2]| {
            print_mm[0] + 2.0 * MARGIN_MM <= width
                && print_mm[1] + 2.0 * MARGIN_MM + FOOT_MM <= height
        };
        let candidates = PAPERS.iter().filter(|(name, _)| paper.is_none_or(|p| p == *name));
        let chosen = candidates.clone().find(|(_, size)| fits(*size));
        let Some(&(paper, size_mm)) = chosen else {
            let &(paper, paper_mm) = candidates.clone().next_back().unwrap_or(&PAPERS[4]);
            return Err(PaperError { size_mm: print_mm, paper, paper_mm });
        };
        let origin_mm =
            [(size_mm[0] - print_mm[0]) / 2.0, (size_mm[1] - FOOT_MM - print_mm[1]) / 2.0];
        let mut sheet = Self { board: *board, paper, size_mm, shapes: Vec::new(), origin_mm };
        sheet.draw_print();
        sheet.draw_ruler();
        Ok(sheet)
    }

    fn draw_print(&mut self) {
        let [x0, y0] = self.origin_mm;
        let board = self.board;
        let pitch = 1e3 * board.pitch_m;
        match board.pattern {
            Pattern::Charuco => {
                let (columns, rows, black) = board.modules();
                let module = pitch * board.columns as f64 / columns as f64;
                for row in 0..rows {
                    // Runs of black modules become one rectangle: no seams within.
                    let line = &black[row * columns..][..columns];
                    let mut column = 0;
                    for run in line.chunk_by(|a, b| a == b) {
                        if run[0] {
                            self.shapes.push(Shape::Rectangle {
                                x: x0 + column as f64 * module,
                                y: y0 + row as f64 * module,
                                width: run.len() as f64 * module,
                                height: module,
                            });
                        }
                        column += run.len();
                    }
                }
            }
            Pattern::Circles => {
                let radius = 1e3 * board.disc_radius_m().unwrap_or(0.0);
                for row in 0..board.rows {
                    for column in 0..board.columns {
                        let hole = board.hollow().contains(&(column, row));
                        self.shapes.push(Shape::Disc {
                            x: x0 + (column as f64 + 0.5) * pitch,
                            y: y0 + (row as f64 + 0.5) * pitch,
                            radius,
                            hole: hole.then_some(1e3 * board.hole_radius_m()),
                        });
                    }
                }
            }
        }
    }

    /// A line of 100 mm with ends.
    fn draw_ruler(&mut self) {
        let (x, y) = (MARGIN_MM, self.size_mm[1] - MARGIN_MM);
        let mut bar = |x, y, width, height| {
            self.shapes.push(Shape::Rectangle { x, y, width, height });
        };
        bar(x, y - 0.1, 100.0, 0.2);
        bar(x, y - 2.0, 0.2, 2.0);
        bar(x + 99.8, y - 2.0, 0.2, 2.0);
    }

    fn caption(&self) -> String {
        format!(
            "100 mm - print at 100 %, measure this line and the squares - stspp calibrate --board {}",
            self.board
        )
    }

    /// The sheet as SVG.
    pub fn to_svg(&self) -> String {
        let [width, height] = self.size_mm;
        let mut text = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" \
             viewBox=\"0 0 {width} {height}\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n<path d=\""
        );
        for shape in &self.shapes {
            if let Shape::Rectangle { x, y, width, height } = shape {
                let _ = write!(text, "M{x:.4} {y:.4}h{width:.4}v{height:.4}h-{width:.4}z");
            }
        }
        text.push_str("\" fill=\"black\"/>\n");
        for shape in &self.shapes {
            if let Shape::Disc { x, y, radius, hole } = shape {
                let mut circle = |radius: f64, colour: &str| {
                    let _ = writeln!(
                        text,
                        "<circle cx=\"{x:.4}\" cy=\"{y:.4}\" r=\"{radius:.4}\" fill=\"{colour}\"/>"
                    );
                };
                circle(*radius, "black");
                hole.iter().for_each(|hole| circle(*hole, "white"));
            }
        }
        let (x, y) = (MARGIN_MM + 103.0, height - MARGIN_MM);
        let _ = writeln!(
            text,
            "<text x=\"{x}\" y=\"{y}\" font-family=\"sans-serif\" font-size=\"3\">{}</text>\n</svg>",
            self.caption()
        );
        text
    }

    /// The sheet as PDF.
    pub fn to_pdf(&self) -> Vec<u8> {
        // PDF counts upwards from the lower left corner, in points.
        let mut content = format!("{s:.6} 0 0 {s:.6} 0 0 cm 0 g\n", s = 1.0 / MM_PER_PT);
        let up = |y: f64| self.size_mm[1] - y;
        for shape in &self.shapes {
            match *shape {
                Shape::Rectangle { x, y, width, height } => {
                    let y = up(y + height);
                    let _ = writeln!(content, "{x:.4} {y:.4} {width:.4} {height:.4} re");
                }
                Shape::Disc { x, y, radius, hole } => {
                    circle(&mut content, x, up(y), radius);
                    if let Some(hole) = hole {
                        circle(&mut content, x, up(y), hole);
                    }
                }
            }
        }
        // Even-odd: a circle within a circle is a hole.
        content.push_str("f*\n");
        let (x, y) = (MARGIN_MM + 103.0, MARGIN_MM);
        let _ = writeln!(content, "BT /F1 3 Tf {x} {y} Td ({}) Tj ET", self.caption());
        let [width, height] = self.size_mm.map(|mm| mm / MM_PER_PT);
        let objects = [
            "<< /Type /Catalog /Pages 2 0 R >>".to_owned(),
            "<< /Type /Pages /Kids [3 0 R] /Count 1 >>".to_owned(),
            format!(
                "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4} {height:.4}] /Contents 4 0 R \
                 /Resources << /Font << /F1 5 0 R >> >> >>"
            ),
            format!("<< /Length {} >>\nstream\n{content}endstream", content.len()),
            "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>".to_owned(),
        ];
        let mut pdf = String::from("%PDF-1.4\n");
        let mut offsets = Vec::new();
        for (k, object) in objects.iter().enumerate() {
            offsets.push(pdf.len());
            let _ = write!(pdf, "{} 0 obj\n{object}\nendobj\n", k + 1);
        }
        let start = pdf.len();
        let _ = write!(pdf, "xref\n0 {}\n0000000000 65535 f \n", objects.len() + 1);
        for offset in offsets {
            let _ = writeln!(pdf, "{offset:010} 00000 n ");
        }
        let _ = write!(
            pdf,
            "trailer\n<< /Size {} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n",
            objects.len() + 1
        );
        pdf.into_bytes()
    }
}

/// Appends a circle of four Bezier curves.
fn circle(content: &mut String, x: f64, y: f64, r: f64) {
    let k = QUARTER * r;
    let _ = writeln!(content, "{:.4} {:.4} m", x + r, y);
    for [ax, ay, bx, by, cx, cy] in [
        [r, k, k, r, 0.0, r],
        [-k, r, -r, k, -r, 0.0],
        [-r, -k, -k, -r, 0.0, -r],
        [k, -r, r, -k, r, 0.0],
    ] {
        let _ = writeln!(
            content,
            "{:.4} {:.4} {:.4} {:.4} {:.4} {:.4} c",
            x + ax,
            y + ay,
            x + bx,
            y + by,
            x + cx,
            y + cy
        );
    }
    content.push_str("h\n");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_sheet_is_taken_and_a_small_one_refused() {
        let board = Board::default();
        assert_eq!(Sheet::new(&board, None).unwrap().paper, "A3");
        let small: Board = "circles:9x6:28".parse().unwrap();
        assert_eq!(Sheet::new(&small, None).unwrap().paper, "A4");
        let error = Sheet::new(&board, Some("A4")).unwrap_err().to_string();
        assert!(error.contains("385 x 280 mm") && error.contains("297 x 210"), "{error}");
    }

    #[test]
    fn svg_and_pdf_state_their_size_and_pdf_offsets_point_at_objects() {
        for text in ["charuco:5x4:30", "circles:7x5:25"] {
            let board: Board = text.parse().unwrap();
            let sheet = Sheet::new(&board, None).unwrap();
            let svg = sheet.to_svg();
            assert!(svg.contains("width=\"297mm\" height=\"210mm\""));
            let pdf = String::from_utf8(sheet.to_pdf()).unwrap();
            let table = pdf.split("startxref\n").nth(1).unwrap();
            let start: usize = table.lines().next().unwrap().parse().unwrap();
            assert!(pdf[start..].starts_with("xref"));
            for (k, line) in pdf[start..].lines().skip(3).take(5).enumerate() {
                let offset: usize = line[..10].parse().unwrap();
                assert!(pdf[offset..].starts_with(&format!("{} 0 obj", k + 1)), "{line}");
            }
        }
    }

    /// The area of ink says whether every black cell was drawn, once.
    #[test]
    fn the_ink_is_that_of_the_board() {
        let board: Board = "charuco:5x4:30".parse().unwrap();
        let sheet = Sheet::new(&board, None).unwrap();
        let area: f64 = sheet
            .shapes
            .iter()
            .map(|shape| match shape {
                Shape::Rectangle { width, height, .. } => width * height,
                Shape::Disc { .. } => 0.0,
            })
            .sum();
        let (_, _, black) = board.modules();
        let module = 30.0 / 8.0;
        let expected = black.iter().filter(|b| **b).count() as f64 * module * module;
        // The ruler is 20.72 mm^2.
        assert!((area - expected - 20.72).abs() < 1.0, "{area} {expected}");
    }
}
