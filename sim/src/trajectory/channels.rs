//! Which channels a machine has: a function of its description alone.

use hydroflex_openapi::channel::{Channel, ChannelRole};
use hydroflex_openapi::machine::{MachineFile, SensorQuantity};

/// What a channel reads, by numbers in the machine's order.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Source {
    Valve(usize),
    Length(usize),
    Velocity(usize),
    /// Cylinder, and 0 for the piston side or 1 for the rod side.
    Pressure(usize, usize),
    Force(usize),
    Angle(usize),
    AngularVelocity(usize),
    AngularAcceleration(usize),
    /// Sensor and component.
    Sensor(usize, String),
}

/// Channels in column order: cylinder by cylinder, angle by angle, then the sensors.
#[must_use]
pub fn channels(file: &MachineFile) -> Vec<Channel> {
    plan(file).into_iter().map(|(channel, _)| channel).collect()
}

/// Channels with what they read.
#[allow(clippy::too_many_lines, reason = "a list")]
pub(crate) fn plan(file: &MachineFile) -> Vec<(Channel, Source)> {
    let mut plan = Vec::new();
    let mut add = |name: String, unit: &str, quantity: &str, frame: Option<String>, role, source| {
        let channel = Channel {
            name,
            unit: unit.to_owned(),
            quantity: quantity.to_owned(),
            frame,
            role,
        };
        plan.push((channel, source));
    };
    for (k, cylinder) in file.cylinders.iter().enumerate() {
        let c = &cylinder.name;
        let sensor = ChannelRole::Sensor;
        add(
            format!("valve_{c}_ratio"),
            "1",
            "valve opening",
            None,
            ChannelRole::Command,
            Source::Valve(k),
        );
        add(
            format!("length_{c}_m"),
            "m",
            "length",
            None,
            sensor,
            Source::Length(k),
        );
        add(
            format!("velocity_{c}_m_per_s"),
            "m/s",
            "velocity",
            None,
            sensor,
            Source::Velocity(k),
        );
        add(
            format!("pressure_{c}_piston_pa"),
            "Pa",
            "pressure",
            None,
            sensor,
            Source::Pressure(k, 0),
        );
        add(
            format!("pressure_{c}_rod_pa"),
            "Pa",
            "pressure",
            None,
            sensor,
            Source::Pressure(k, 1),
        );
        add(
            format!("force_{c}_n"),
            "N",
            "force",
            None,
            sensor,
            Source::Force(k),
        );
    }
    for (k, angle) in file.angles.iter().enumerate() {
        let a = &angle.name;
        let motion = ChannelRole::Motion;
        let global = || Some("global".to_owned());
        add(
            format!("angle_{a}_rad"),
            "rad",
            "angle",
            global(),
            motion,
            Source::Angle(k),
        );
        add(
            format!("angular_velocity_{a}_rad_per_s"),
            "rad/s",
            "angular velocity",
            global(),
            motion,
            Source::AngularVelocity(k),
        );
        add(
            format!("angular_acceleration_{a}_rad_per_s2"),
            "rad/s^2",
            "angular acceleration",
            global(),
            motion,
            Source::AngularAcceleration(k),
        );
    }
    for (k, sensor) in file.sensors.iter().enumerate() {
        let (quantity, suffix, unit) = match sensor.quantity {
            SensorQuantity::Deflection => ("deflection", "_m", "m"),
            SensorQuantity::Strain => ("strain", "", "1"),
            SensorQuantity::Stress => ("stress", "_pa", "Pa"),
        };
        for component in &sensor.components {
            add(
                format!("{quantity}_{}_{component}{suffix}", sensor.name),
                unit,
                quantity,
                Some(sensor.body.clone()),
                ChannelRole::Target,
                Source::Sensor(k, component.clone()),
            );
        }
    }
    plan
}
