//! `stspp calibrate board`: a board to print.

use std::path::PathBuf;

use clap::ValueEnum;
use serde_json::json;
use stspp::calibrate::Board;
use stspp::calibrate::print::Sheet;
use stspp::export::atomic;

use super::refuse_existing;
use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Write a board to print, as PDF or SVG by the file's ending.
///
/// Print at 100 %, on matt paper, glue it onto something flat that does not bend (glass, aluminium
/// composite), and measure the ruler and a row of squares: the unit of all measurements is the pitch
/// that --board states.
#[derive(clap::Args)]
pub struct Args {
    /// File to write, .pdf or .svg.
    file: PathBuf,
    /// The board: charuco:COLUMNSxROWS:MM or circles:COLUMNSxROWS:MM.
    #[arg(long, default_value_t)]
    board: Board,
    /// Sheet [default: the smallest that it fits on].
    #[arg(long, value_enum)]
    paper: Option<Paper>,
    /// Replace the file if it is there.
    #[arg(long)]
    force: bool,
}

/// Sheets.
#[derive(ValueEnum, Clone, Copy)]
enum Paper {
    A4,
    A3,
    A2,
    A1,
    A0,
}

impl Paper {
    fn name(self) -> &'static str {
        match self {
            Self::A4 => "A4",
            Self::A3 => "A3",
            Self::A2 => "A2",
            Self::A1 => "A1",
            Self::A0 => "A0",
        }
    }
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let ending = args.file.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let is_pdf = match ending.to_ascii_lowercase().as_str() {
        "pdf" => true,
        "svg" => false,
        _ => {
            let what =
                format!("{}: expected a name that ends in .pdf or .svg", args.file.display());
            return Err(Failure::new(Kind::Usage, what));
        }
    };
    let sheet = Sheet::new(&args.board, args.paper.map(Paper::name)).map_err(|error| {
        Failure::new(Kind::Input, error).remedy("take a smaller pitch or a larger --paper")
    })?;
    refuse_existing(&args.file, args.force)?;
    let bytes = if is_pdf { sheet.to_pdf() } else { sheet.to_svg().into_bytes() };
    atomic::write_file(&args.file, |out| out.write_all(&bytes)).map_err(|error| {
        Failure::new(Kind::Output, format!("{}: cannot be written: {error}", args.file.display()))
    })?;
    let text = format!(
        "{} on {} in {}\nprint at 100 %, then: stspp calibrate --board {} ...",
        args.board,
        sheet.paper,
        args.file.display(),
        args.board
    );
    let json = json!({
        "file": args.file,
        "paper": sheet.paper,
        "board": args.board.to_string(),
        "points": args.board.point_count(),
    });
    output.result(&text, &json);
    Ok(())
}
