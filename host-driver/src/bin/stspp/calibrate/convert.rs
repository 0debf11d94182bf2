//! `stspp calibrate import` and `export`: OpenCV's and ROS' files.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde_json::json;
use stspp::StereoCalibration;
use stspp::calibration::opencv::{self, OpenCvImport};
use stspp::calibration::{CalibrationError, export as texts, ros};
use stspp::export::atomic;

use super::refuse_existing;
use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Formats of other programs.
#[derive(ValueEnum, Clone, Copy)]
enum Format {
    /// Stereo YAML with M1 D1 M2 D2 R T, in one file or two.
    Opencv,
    /// A pair of camera_info files, left and right.
    Ros,
}

/// Make a camchain.yaml of a calibration of another program.
#[derive(clap::Args)]
pub struct ImportArgs {
    /// OpenCV: one file, or intrinsics and extrinsics. ROS: the left and the right camera_info.
    #[arg(required = true, num_args = 1..=2)]
    files: Vec<PathBuf>,
    /// Whose format.
    #[arg(long, value_enum)]
    from: Format,
    /// OpenCV: millimetres per unit of its T, that is of the squares it was calibrated with.
    #[arg(long, default_value_t = 1000.0, value_name = "MM")]
    unit_mm: f64,
    /// OpenCV: image size, where the file does not state it.
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<[usize; 2]>,
    /// Calibration file to write.
    #[arg(long, short, default_value = "camchain.yaml")]
    out: PathBuf,
    /// Replace the file if it is there.
    #[arg(long)]
    force: bool,
}

/// Make files for other programs of a camchain.yaml.
#[derive(clap::Args)]
pub struct ExportArgs {
    /// The calibration.
    #[arg(default_value = "camchain.yaml")]
    file: PathBuf,
    /// Whose format.
    #[arg(long, value_enum)]
    to: Format,
    /// File to write; for ROS a folder, for left.yaml and right.yaml.
    #[arg(long, short)]
    out: PathBuf,
    /// Replace files that are there.
    #[arg(long)]
    force: bool,
}

fn parse_size(text: &str) -> Result<[usize; 2], String> {
    text.split_once('x')
        .and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]))
        .ok_or_else(|| "expected WIDTHxHEIGHT, such as 1280x1024".to_owned())
}

/// A calibration failure: of reading or of writing.
pub fn calibration_failure(error: CalibrationError) -> Failure {
    let kind = match error {
        CalibrationError::Write { .. } => Kind::Output,
        _ => Kind::Input,
    };
    Failure::new(kind, error)
}

/// Runs `import`.
pub fn import(args: &ImportArgs, output: &Output) -> Result<(), Failure> {
    refuse_existing(&args.out, args.force)?;
    let files: Vec<&Path> = args.files.iter().map(PathBuf::as_path).collect();
    let calibration = match (args.from, &files[..]) {
        (Format::Opencv, files) => {
            let options = OpenCvImport { unit_m: args.unit_mm * 1e-3, resolution_px: args.size };
            opencv::import(files, &options)
        }
        (Format::Ros, [left, right]) => ros::import(left, right),
        (Format::Ros, _) => {
            let what = "--from ros: expected two files, the left and the right camera_info";
            return Err(Failure::new(Kind::Usage, what));
        }
    }
    .map_err(calibration_failure)?;
    calibration.write(&args.out).map_err(calibration_failure)?;
    let text =
        format!("baseline {:.4} m; written: {}", calibration.baseline_m(), args.out.display());
    let json = json!({ "file": args.out, "baseline_m": calibration.baseline_m() });
    output.result(&text, &json);
    Ok(())
}

/// Runs `export`.
pub fn export(args: &ExportArgs, output: &Output) -> Result<(), Failure> {
    let calibration = StereoCalibration::read(&args.file).map_err(calibration_failure)?;
    let files: Vec<(PathBuf, String)> = match args.to {
        Format::Opencv => vec![(args.out.clone(), texts::opencv_text(&calibration))],
        Format::Ros => {
            let [left, right] =
                texts::ros_texts(&calibration).map_err(|e| Failure::new(Kind::Input, e))?;
            vec![(args.out.join("left.yaml"), left), (args.out.join("right.yaml"), right)]
        }
    };
    for (path, _) in &files {
        refuse_existing(path, args.force)?;
    }
    let failed = |path: &Path, error: std::io::Error| {
        Failure::new(Kind::Output, format!("{}: cannot be written: {error}", path.display()))
    };
    if matches!(args.to, Format::Ros) {
        std::fs::create_dir_all(&args.out).map_err(|error| failed(&args.out, error))?;
    }
    for (path, text) in &files {
        atomic::write_file(path, |out| out.write_all(text.as_bytes()))
            .map_err(|error| failed(path, error))?;
    }
    let names: Vec<String> = files.iter().map(|(path, _)| path.display().to_string()).collect();
    output.result(&format!("written: {}", names.join(", ")), &json!({ "files": names }));
    Ok(())
}
