//! Build and test tasks: `cargo xtask help`.

fn main() {
    println!("cargo xtask test");
}
