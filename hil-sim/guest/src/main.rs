//! First process of the virtual machine of the end-to-end test.
//!
//! ```text
//! main     mounts what a program expects, loads the modules, then
//! control  runs what the host asks for over the ports `control` and `side`, until it says `poweroff`
//! bridge   lays a USB/IP stream from a virtio port into the kernel's virtual host controller
//! ```
//! There is no shell, no udev and no network in this machine.

mod bridge;
mod control;
mod modules;
mod ports;
mod sys;

fn main() {
    let outcome = start().and_then(|()| {
        std::thread::Builder::new().name("side".into()).spawn(|| control::serve("side"))?;
        control::serve("control")
    });
    if let Err(e) = outcome {
        eprintln!("guest-init: {e}");
    }
    sys::power_off();
}

fn start() -> std::io::Result<()> {
    sys::mount_all()?;
    modules::load_all("/modules/order")?;
    println!("guest-init: up");
    Ok(())
}
