//! `stspp experiment`: the paper's evaluation on the simulated sensor.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::ValueEnum;
use serde_json::json;
use stspp::cpu_time::process_cpu_ms;
use stspp::experiment::{ExperimentError, Figure, Section, Studio, report};
use stspp::export::folder::OutputFolder;
use stspp::report::peak_memory_bytes;

use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::output::Output;
use crate::reconstruct::{MethodName, OrderName, output_failure};

/// Repeat the paper's experiments on the simulated sensor: report.html, report.md, report.json.
///
/// Scenes are rendered once and kept as recordings in OUT/recordings; a second run reuses them.
#[derive(clap::Args)]
pub struct Args {
    /// Figures: fig2 to fig8, or all.
    #[arg(required = true)]
    figures: Vec<FigureName>,
    /// Folder to write to; made if missing, reports in it are replaced.
    #[arg(long, short)]
    out: PathBuf,
    /// Seed of the simulated sensor: other dots, tolerances and noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Sub-pixel method [default: each figure's own, icgn for 2, 3, 4 and 7, dense for 5, 6 and 8].
    #[arg(long, value_enum)]
    method: Option<MethodName>,
    /// Order of the subset's shape function [default: each figure's own].
    #[arg(long, value_enum)]
    order: Option<OrderName>,
    /// Threads to use [default: all cores].
    #[arg(long)]
    threads: Option<usize>,
}

/// Names of [`Figure`].
#[derive(ValueEnum, Clone, Copy, PartialEq)]
enum FigureName {
    /// Plane and sphere over the number of patterns.
    Fig2,
    /// Statue: parabola and DIC.
    Fig3,
    /// Statue over the number of patterns.
    Fig4,
    /// Planes over distance and number of patterns.
    Fig5,
    /// Turning statue, moving plane.
    Fig6,
    /// Industrial part.
    Fig7,
    /// Large panel.
    Fig8,
    /// All of them.
    All,
}

impl FigureName {
    fn figures(self) -> Vec<Figure> {
        match self {
            Self::Fig2 => vec![Figure::Fig2],
            Self::Fig3 => vec![Figure::Fig3],
            Self::Fig4 => vec![Figure::Fig4],
            Self::Fig5 => vec![Figure::Fig5],
            Self::Fig6 => vec![Figure::Fig6],
            Self::Fig7 => vec![Figure::Fig7],
            Self::Fig8 => vec![Figure::Fig8],
            Self::All => Figure::ALL.to_vec(),
        }
    }
}

fn failure((figure, error): &(Figure, ExperimentError)) -> Failure {
    let what = format!("{}: {error}", figure.name());
    match error {
        ExperimentError::Write { .. } | ExperimentError::Picture(_) => {
            Failure::new(Kind::Output, what)
        }
        ExperimentError::Recording(_) => Failure::new(Kind::Input, what)
            .remedy("remove the kept recording, or give another --out"),
        _ => Failure::new(Kind::Other, what),
    }
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let begun = Instant::now();
    let mut figures: Vec<Figure> = args.figures.iter().flat_map(|f| f.figures()).collect();
    figures.sort_unstable();
    figures.dedup();
    // Recordings are kept whatever becomes of the report: the folder is there from the beginning.
    std::fs::create_dir_all(&args.out).map_err(|e| {
        Failure::new(Kind::Output, format!("{}: cannot be made: {e}", args.out.display()))
    })?;
    let mut out = OutputFolder::create(&args.out, true).map_err(|e| output_failure(&e))?;
    let progress = output.progress(figures.len() as u64, "figures");
    progress.enable_steady_tick(Duration::from_millis(200));
    let mut sections: Vec<Section> = Vec::new();
    let mut failed: Vec<(Figure, ExperimentError)> = Vec::new();
    let mut say = |what: String| progress.set_message(what);
    let asked = (args.method.map(MethodName::method), args.order.map(OrderName::shape));
    let recordings = args.out.join("recordings");
    let mut studio = Studio::new(&recordings, args.seed, asked, args.threads, &mut say);
    for figure in figures {
        match figure.run(&mut studio) {
            Ok(section) => sections.push(section),
            // The other figures took minutes each: they are reported all the same.
            Err(error) => failed.push((figure, error)),
        }
        interrupt::check()?;
        progress.inc(1);
    }
    if sections.is_empty()
        && let Some(first) = failed.first()
    {
        return Err(failure(first));
    }
    let (rendered, reused) = (studio.rendered, studio.reused);
    let seconds = begun.elapsed().as_secs_f64();
    let memory = peak_memory_bytes().map_or(String::new(), |bytes| {
        format!(", peak memory {:.1} GiB", bytes as f64 / f64::from(1 << 30))
    });
    let cpu_seconds = process_cpu_ms().map(|ms| ms * 1e-3);
    let cpu = cpu_seconds.map_or(String::new(), |s| format!(" ({s:.0} s of CPU)"));
    let made_by = format!(
        "stspp {}, seed {}; {:.0} s on {} threads{cpu}, {rendered} recordings rendered, {reused} \
         reused{memory}.",
        env!("CARGO_PKG_VERSION"),
        args.seed,
        seconds,
        std::thread::available_parallelism().map_or(1, usize::from),
    );
    let json = json!({
        "made_by": made_by, "seconds": seconds, "cpu_seconds": cpu_seconds,
        "failed": failed.iter().map(|(figure, error)| json!({
            "figure": figure.name(), "error": error.to_string(),
        })).collect::<Vec<_>>(),
        "figures": sections.iter().map(|s| json!({
            "figure": s.figure.name(), "title": s.title, "seconds": s.seconds,
            "cpu_seconds": s.cpu_seconds,
            "rows": s.rows.iter().map(|r| json!({
                "quantity": r.quantity, "paper": r.paper, "ours": r.ours,
                "better": r.is_better(), "note": r.note,
            })).collect::<Vec<_>>(),
        })).collect::<Vec<_>>(),
    });
    let unwritable = |e| output_failure(&e);
    out.file("report.html", |w| w.write_all(report::html(&sections, &made_by).as_bytes()))
        .map_err(unwritable)?;
    let markdown = report::markdown(&sections, &made_by);
    out.file("report.md", |w| w.write_all(markdown.as_bytes())).map_err(unwritable)?;
    out.file("report.json", |w| writeln!(w, "{json:#}")).map_err(unwritable)?;
    out.commit().map_err(unwritable)?;
    progress.finish_and_clear();
    let mut text = String::new();
    for section in &sections {
        let cpu = section.cpu_seconds.map_or(String::new(), |s| format!(", {s:.0} s of CPU"));
        text += &format!(
            "\n{}: {} ({:.0} s{cpu})\n",
            section.figure.name(),
            section.title,
            section.seconds
        );
        for row in &section.rows {
            let paper = row.paper.map_or("-".into(), |v| format!("{v:.*}", row.digits));
            let word = row.is_better().map_or("", |b| if b { "better" } else { "WORSE" });
            text += &format!(
                "  {:<72} paper {paper:>10}  ours {:>12}  {word}\n",
                row.quantity,
                format!("{:.*}", row.digits, row.ours)
            );
        }
    }
    text += &format!("\n{made_by}\nlook at {}", args.out.join("report.html").display());
    output.result(&text, &json);
    failed
        .first()
        .map_or(Ok(()), |first| Err(failure(first).remedy("the report holds the other figures")))
}
