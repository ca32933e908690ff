//! Machines and meshes that the binary carries.

/// A machine file.
pub(super) struct BuiltInMachine {
    pub(super) name: &'static str,
    pub(super) text: &'static str,
}

/// The machines; the first is the default.
pub(super) const MACHINES: [BuiltInMachine; 3] = [
    BuiltInMachine {
        name: "lift-boom",
        text: include_str!("../../machines/lift-boom.toml"),
    },
    BuiltInMachine {
        name: "lift-boom-published",
        text: include_str!("../../machines/lift-boom-published.toml"),
    },
    BuiltInMachine {
        name: "crane-published",
        text: include_str!("../../machines/crane-published.toml"),
    },
];

/// A mesh file.
pub(super) struct BuiltInMesh {
    pub(super) name: &'static str,
    pub(super) text: &'static str,
}

/// The meshes.
pub(super) const MESHES: [BuiltInMesh; 1] = [BuiltInMesh {
    name: "lift-boom",
    text: include_str!("../../machines/lift-boom/lift-boom.inp"),
}];

/// Text of a built-in mesh.
pub(super) fn mesh(name: &str) -> Option<&'static str> {
    let found = MESHES.iter().find(|mesh| mesh.name == name);
    found.map(|mesh| mesh.text)
}

/// Names of the built-in meshes.
pub(super) fn mesh_names() -> Vec<&'static str> {
    MESHES.iter().map(|mesh| mesh.name).collect()
}
