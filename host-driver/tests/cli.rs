//! The command line from outside: exit codes, one-line errors, nothing left behind.
#![cfg(feature = "cli")]

mod common;

use std::process::{Command, Output};

use common::Folder;

fn stspp(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_stspp")).args(arguments).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn help_documents_the_exit_codes() {
    let output = stspp(&["--help"]);
    assert!(output.status.success());
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("Exit codes") && text.contains("reconstruct"), "{text}");
}

#[test]
fn wrong_inputs_exit_with_3_and_one_line() {
    let folder = Folder::new("cli-wrong");
    let (here, out) = (folder.path("recording"), folder.path("out"));
    let (here, out) = (here.to_str().unwrap(), out.to_str().unwrap());
    let missing = stspp(&["reconstruct", here, "--out", out]);
    assert_eq!(missing.status.code(), Some(3));
    assert_eq!(stderr(&missing).trim_end().lines().count(), 1, "{}", stderr(&missing));
    assert!(stderr(&missing).contains("recording") && stderr(&missing).starts_with("error: "));
    std::fs::create_dir(here).unwrap();
    std::fs::write(format!("{here}/camchain.yaml"), "cam0: {camera_model: omni}\ncam1: {}\n")
        .unwrap();
    let wrong = stspp(&["--json", "reconstruct", here, "--out", out]);
    assert_eq!(wrong.status.code(), Some(3));
    let text = stderr(&wrong);
    assert!(text.contains("camchain.yaml:1: cam0.camera_model: expected `pinhole`"), "{text}");
    assert_eq!(folder.names(), ["recording"]);
}

#[test]
fn wrong_usage_exits_with_2() {
    assert_eq!(stspp(&["reconstruct"]).status.code(), Some(2));
    assert_eq!(stspp(&["reconstruct", "x", "--out", "y", "--order", "3"]).status.code(), Some(2));
    assert_eq!(stspp(&["bench", "accuracy", "moon"]).status.code(), Some(2));
}
