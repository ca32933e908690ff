//! What the targets share.

use hydroflex_openapi::job::JobSpec;
use hydroflex_openapi::machine::MachineFile;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario;
use std::sync::LazyLock;

#[cfg(feature = "service")]
pub mod service;

static BOOM: LazyLock<MachineFile> = LazyLock::new(|| {
    let text = Machine::built_in_text("lift-boom").expect("a built-in machine");
    Machine::parse_file(text).expect("a valid machine")
});

/// Reads a job and checks it against the built-in boom.
pub fn job(data: &[u8]) {
    if let Ok(spec) = serde_json::from_slice::<JobSpec>(data)
        && scenario::validate(&spec, &BOOM).is_ok()
    {
        // What is accepted is bounded in every dimension that costs memory.
        assert!(spec.steps() < 10_000_000);
    }
}
