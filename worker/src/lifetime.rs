//! A worker never outlives the process that started it.

use nix::sys::signal::Signal;
use nix::unistd::Pid;
use std::time::Duration;

/// How often the parent is looked for where the kernel does not tell.
const LOOK: Duration = Duration::from_millis(500);

/// Ties this process to its parent: the kernel kills it when the parent's thread that started it
/// ends, and a thread looks for the parent now and then, should the kernel not do so.
///
/// # Errors
/// If the parent has gone already, or no thread can be started.
pub fn die_with_parent(parent: u32) -> anyhow::Result<()> {
    #[cfg(target_os = "linux")]
    nix::sys::prctl::set_pdeathsig(Signal::SIGKILL)?;
    // The parent may have gone before the line above took effect.
    anyhow::ensure!(has_parent(parent), "the parent process {parent} has gone");
    std::thread::Builder::new()
        .name("parent-watch".to_owned())
        .spawn(move || {
            while has_parent(parent) {
                std::thread::sleep(LOOK);
            }
            // No farewell: the parent may have been killed to stop everything at once.
            let _ = nix::sys::signal::kill(Pid::this(), Signal::SIGKILL);
        })?;
    Ok(())
}

fn has_parent(parent: u32) -> bool {
    u32::try_from(Pid::parent().as_raw()) == Ok(parent)
}
