//! How verbs speak: results on standard output (text or JSON), progress on standard error.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

/// The global output options.
pub struct Output {
    /// One JSON object instead of text.
    pub json: bool,
    /// No progress.
    pub quiet: bool,
}

impl Output {
    /// A progress bar of `length` steps on standard error; hidden when quiet or not a terminal.
    pub fn progress(&self, length: u64, what: &'static str) -> ProgressBar {
        if self.quiet {
            return ProgressBar::hidden();
        }
        let bar = ProgressBar::new(length).with_message(what);
        if let Ok(style) =
            ProgressStyle::with_template("{msg:>14} [{bar:30}] {pos}/{len} {elapsed}")
        {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        bar
    }

    /// A spinner for work of unknown length; its message says what goes on.
    pub fn spinner(&self) -> ProgressBar {
        if self.quiet {
            return ProgressBar::hidden();
        }
        let spinner = ProgressBar::new_spinner();
        spinner.enable_steady_tick(Duration::from_millis(200));
        spinner
    }

    /// Prints a result: `text` for people, `json` for programs.
    pub fn result(&self, text: &str, json: &serde_json::Value) {
        if self.json {
            println!("{json:#}");
        } else {
            println!("{}", text.trim_end());
        }
    }
}
