//! Synthetic runs: smooth, seeded, of the shape that the lift boom has.

use hydroflex_dataset::{PublishSpec, RunKind, RunOutcome, RunRecord, RunSamples, RunStatistics};
use hydroflex_openapi::channel::{Channel, ChannelRole};
use hydroflex_openapi::dataset::{CodeFacts, MachineFacts};
use hydroflex_openapi::job::{JobSpec, RunFlag, SolverPath};

pub(crate) const STEPS: usize = 200;

const CHANNELS: [(&str, &str, ChannelRole, f64); 14] = [
    ("valve_lift_ratio", "1", ChannelRole::Command, 1.0),
    ("length_lift_m", "m", ChannelRole::Sensor, 0.02),
    ("velocity_lift_m_per_s", "m/s", ChannelRole::Sensor, 0.2),
    ("pressure_lift_piston_pa", "Pa", ChannelRole::Sensor, 9e6),
    ("pressure_lift_rod_pa", "Pa", ChannelRole::Sensor, 12e6),
    ("force_lift_n", "N", ChannelRole::Motion, 6e4),
    ("angle_lift_rad", "rad", ChannelRole::Motion, 0.07),
    (
        "angular_velocity_lift_rad_per_s",
        "rad/s",
        ChannelRole::Motion,
        0.6,
    ),
    (
        "angular_acceleration_lift_rad_per_s2",
        "rad/s²",
        ChannelRole::Motion,
        77.0,
    ),
    ("deflection_tip_x_m", "m", ChannelRole::Target, 1e-4),
    ("deflection_tip_y_m", "m", ChannelRole::Target, 5e-3),
    ("deflection_tip_z_m", "m", ChannelRole::Target, 1e-6),
    ("strain_tip_xy", "1", ChannelRole::Target, 2e-6),
    ("stress_root_xx_pa", "Pa", ChannelRole::Target, 4e7),
];

pub(crate) fn channels() -> Vec<Channel> {
    CHANNELS
        .iter()
        .map(|&(name, unit, role, _)| Channel {
            name: name.to_owned(),
            unit: unit.to_owned(),
            quantity: name.split('_').next().unwrap().to_owned(),
            frame: (role == ChannelRole::Target).then(|| "boom".to_owned()),
            role,
        })
        .collect()
}

pub(crate) fn job(json: &str) -> JobSpec {
    serde_json::from_str(json).unwrap()
}

pub(crate) fn publish_spec(job: JobSpec) -> PublishSpec {
    let machine = MachineFacts {
        name: "lift-boom".to_owned(),
        toml: "format = 1\n".to_owned(),
        content_sha256: "00".repeat(32),
        angles: vec!["lift".to_owned()],
    };
    let code = CodeFacts {
        version: "0.1.0".to_owned(),
        instruction_set: "portable".to_owned(),
    };
    PublishSpec::of_job(job, machine, code, channels())
}

/// A sum of damped oscillations excited at random instants: about as hard to compress as the boom.
pub(crate) fn record(kind: RunKind, run_id: u64, steps: usize) -> RunRecord {
    let mut state = run_id.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ u64::from(kind == RunKind::Settling);
    let mut unit = move || {
        // splitmix64
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    };
    let columns = CHANNELS
        .iter()
        .map(|&(_, _, role, scale)| {
            if role == ChannelRole::Command {
                let closing = steps / 5;
                return (0..=steps)
                    .map(|k| match kind {
                        RunKind::Settling => f64::from(u8::from(k > 0 && k <= closing)),
                        RunKind::Job => f64::from(k > 0) * (2.0 * unit() - 1.0),
                    })
                    .collect();
            }
            let kicks: Vec<(f64, f64, f64)> = (0..5)
                .map(|_| (unit() * steps as f64, scale * (unit() - 0.5), 0.05 + 0.5 * unit()))
                .collect();
            let offset = scale * unit();
            (0..=steps)
                .map(|k| {
                    let ringing = kicks.iter().map(|&(at, size, rate)| {
                        let t = k as f64 - at;
                        if t < 0.0 {
                            0.0
                        } else {
                            size * (-t / 30.0).exp() * (rate * t).sin()
                        }
                    });
                    offset + ringing.sum::<f64>()
                })
                .collect()
        })
        .collect();
    RunRecord {
        kind,
        run_id,
        seed: Some(run_id ^ 0xabcd),
        payload_kg: 100.0 * unit(),
        material: run_id.is_multiple_of(3).then(|| "aluminium".to_owned()),
        angles_rad: vec![unit()],
        outcome: RunOutcome::Ok(RunSamples {
            sample_count: steps + 1,
            columns,
        }),
        flags: if run_id % 5 == 1 {
            vec![RunFlag::StrokeCutoff, RunFlag::Cavitation]
        } else {
            Vec::new()
        },
        statistics: RunStatistics {
            steps: 232,
            rejected: run_id % 3,
            iterations: 0,
            factorisations: 240,
            path: Some(SolverPath::Planar),
        },
    }
}

pub(crate) fn failed(run_id: u64) -> RunRecord {
    RunRecord {
        outcome: RunOutcome::Failed {
            reason: "not converged at t = 0.125 s after 20 iterations".to_owned(),
        },
        ..record(RunKind::Job, run_id, 1)
    }
}
