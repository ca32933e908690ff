#!/usr/bin/env python3
"""What a simulated second of the two-boom crane costs: hydroflex and Exudyn, in turns, in one run of this script.

    pip install exudyn==1.13.6 scikit-fem numpy scipy pyarrow
    cargo build --release --example run_table
    python sim/validation/benchmark_exudyn_crane.py --mesh lift=LiftBoom-Job-1.inp --mesh tilt=TiltBoom-Job-1.inp \
        --out docs/benchmark-crane.md

Both simulate sim/machines/crane-published.toml with random valve signals of 1 s on both cylinders, sampled every 5 ms, on
one thread. Exudyn is driven at its best (exudyn_crane.py: data in memory, four substitute nodes per interface, friction,
a Python function there, left out, modified Newton) with the scheme and the largest step whose median error over the runs is
within 1e-3 of the channel's range in its worst channel. Reference for Exudyn and, beside it, for hydroflex: Exudyn with steps
of --fine-s. Figures are user CPU time, of Exudyn of the time integration alone, of hydroflex of the whole run (static start
and recording of all channels included).
"""
import argparse
import json
import math
import os
import re
import statistics
import subprocess
import sys
import tempfile
import tomllib
from datetime import date

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import exudyn as exu  # noqa: E402
from benchmark_exudyn import processor  # noqa: E402
from exudyn_crane import Model, simulate  # noqa: E402

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
MACHINE = os.path.join(ROOT, "sim/machines/crane-published.toml")
SAMPLE_S = 0.005
PAYLOADS_KG = (0.0, 50.0, 100.0)
STEPS_S = (5e-3, 2.5e-3, 1.25e-3, 1e-3, 6.25e-4, 5e-4, 2.5e-4)
SCHEMES = ("trapezoidal-index-2", "generalized-alpha")
# Where the reference starts; the range of random starts below.
STATIC_TOLERANCE = 1e-4
LIFT_DEG, TILT_DEG = (5.0, 25.0), (0.0, 10.0)


def random_runs(per_payload, seed):
    """The paper's signal: a fifth each of full open, full shut, closed, ramps and noise, in random order."""
    draw = np.random.default_rng(seed)

    def signal():
        ramps = np.concatenate([np.linspace(*draw.uniform(-1, 1, 2), 8) for _ in range(5)])
        blocks = [np.ones(40), -np.ones(40), np.zeros(40), ramps, draw.uniform(-1, 1, 40)]
        draw.shuffle(blocks)
        return np.concatenate(blocks).tolist()

    return [{"run_id": k, "payload_kg": PAYLOADS_KG[k // per_payload],
             "angle_lift_rad": math.radians(draw.uniform(*LIFT_DEG)), "angle_tilt_rad": math.radians(draw.uniform(*TILT_DEG)),
             "valve_lift_ratio": signal(), "valve_tilt_ratio": signal()} for k in range(per_payload * len(PAYLOADS_KG))]


def exudyn_run(model, run, scheme, step_s):
    return simulate(model, run, scheme, step_s, SAMPLE_S, False, STATIC_TOLERANCE, False)


def channels(machine):
    names = []
    for c in machine["cylinder"]:
        names += [f"length_{c['name']}_m", f"velocity_{c['name']}_m_per_s", f"pressure_{c['name']}_piston_pa",
                  f"pressure_{c['name']}_rod_pa"]
    for a in machine["angle"]:
        names += [f"angle_{a['name']}_rad", f"angular_velocity_{a['name']}_rad_per_s"]
    return [*names, "deflection_tip_y_m"]


def error_of(names, runs, results, reference):
    """Of each run the largest error over the channel's median range over the runs of its payload; the worst channel's median,
    and the largest of all."""
    medians, largest = [], 0.0
    for c in names:
        scale = {p: statistics.median(float(np.ptp(r[c])) for run, r in zip(runs, reference) if run["payload_kg"] == p)
                 for p in PAYLOADS_KG}
        off = [float(np.max(np.abs(np.asarray(a[c]) - b[c]))) / scale[run["payload_kg"]]
               for run, a, b in zip(runs, results, reference)]
        medians.append(statistics.median(off))
        largest = max(largest, max(off))
    return max(medians), largest


def ours(program, meshes, runs, folder):
    """Channels and user CPU seconds of every run."""
    table, out = os.path.join(folder, "runs.json"), os.path.join(folder, "out.json")
    with open(table, "w") as file:
        json.dump([{"run_id": r["run_id"], "payload_kg": r["payload_kg"],
                    "angles_rad": [r["angle_lift_rad"], r["angle_tilt_rad"]],
                    "valves_ratio": [r["valve_lift_ratio"], r["valve_tilt_ratio"]]} for r in runs], file)
    given = [x for name, path in meshes.items() for x in ("--mesh", f"{name}={path}")]
    text = subprocess.run([program, "crane-published", table, out, "accurate", *given], check=True, capture_output=True,
                          text=True).stdout
    spent = {int(k): float(ms) * 1e-3 for k, ms in re.findall(r"run (\d+): [\d.]+ ms \(([\d.]+) ms of the processor\)", text)}
    results = {r["run_id"]: r["columns"] for r in json.load(open(out))}
    missing = [r["run_id"] for r in runs if r["run_id"] not in results or r["run_id"] not in spent]
    assert not missing, f"runs {missing} failed"
    return [results[r["run_id"]] for r in runs], [spent[r["run_id"]] for r in runs]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", action="append", required=True, metavar="BODY=FILE")
    parser.add_argument("--out", help="write the table to this Markdown file (default: standard output)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--runs", type=int, default=3, help="random runs per payload (default: 3)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fine-s", type=float, default=1e-4, help="Exudyn's step for the reference (default: 1e-4)")
    parser.add_argument("--program", default=os.path.join(ROOT, "target/release/examples/run_table"))
    a = parser.parse_args()
    meshes = dict(m.split("=", 1) for m in a.mesh)
    machine = tomllib.load(open(MACHINE, "rb"))
    names, runs = channels(machine), random_runs(a.runs, a.seed)
    model = Model(machine, meshes)
    reference = [exudyn_run(model, r, "generalized-alpha", a.fine_s)[0] for r in runs]
    tried, cost = [], {}
    for scheme in SCHEMES:
        for step_s in STEPS_S:
            results = [exudyn_run(model, r, scheme, step_s) for r in runs]
            error, largest = error_of(names, runs, [c for c, _ in results], reference)
            spent = statistics.median(s for _, s in results)
            tried.append((scheme, step_s, error, largest, spent))
            print(f"  {scheme} {step_s * 1e3:g} ms: median error {error:.1e}, largest {largest:.1e}, {spent * 1e3:.0f} ms", flush=True)
            if error <= 1e-3:
                break
    best = min((t for t in tried if t[2] <= 1e-3), key=lambda t: t[4])
    with tempfile.TemporaryDirectory() as folder:
        for k in range(a.rounds):
            print(f"round {k + 1} of {a.rounds}", flush=True)
            mine, spent = ours(a.program, meshes, runs, folder)
            for p in PAYLOADS_KG:
                of = [i for i, r in enumerate(runs) if r["payload_kg"] == p]
                cost.setdefault(("hydroflex", p), []).extend(spent[i] for i in of)
                for row, step_s in (("exudyn 5 ms", SAMPLE_S), ("exudyn", best[1])):
                    cost.setdefault((row, p), []).extend(exudyn_run(model, runs[i], best[0], step_s)[1] for i in of)
    median = {key: statistics.median(values) for key, values in cost.items()}
    text = table(a, median, tried, best, error_of(names, runs, mine, reference))
    if a.out:
        open(a.out, "w").write(text)
    else:
        print(text)


def table(a, median, tried, best, own):
    rows = [("Exudyn at its best, 5 ms (time integration)", "exudyn 5 ms"),
            (f"Exudyn at its best, median error within 1e-3 (`{best[0]}`, {best[1] * 1e3:g} ms; time integration)", "exudyn"),
            ("hydroflex `accurate`, alone (whole run)", "hydroflex")]
    lines = [
        "# What a simulated second of the crane costs", "",
        f"Written by `python sim/validation/benchmark_exudyn_crane.py --mesh lift=LiftBoom-Job-1.inp --mesh tilt=TiltBoom-Job-1.inp "
        f"--rounds {a.rounds} --runs {a.runs} --seed {a.seed} --fine-s {a.fine_s:g}` on {date.today().isoformat()}: {processor()}, "
        f"{os.cpu_count()} cores; Exudyn {exu.__version__}. Load average at the end {os.getloadavg()[0]:.0f}; other programs slow "
        "both, so compare the ratios.", "",
        f"Machine: `crane-published`, {a.runs} random runs of 1 s per payload, valve signals of the paper on both cylinders, samples every "
        "5 ms, one thread. Milliseconds of user CPU per run, medians over the runs and rounds, hydroflex and Exudyn in turns. "
        "Reducing the bodies is in none of the rows.", "",
        "| | 0 kg | 50 kg | 100 kg |", "|---|---|---|---|"]
    for title, row in rows:
        lines.append(f"| {title} | " + " | ".join(f"{median[row, p] * 1e3:.3g}" for p in PAYLOADS_KG) + " |")
    lines.append("| **times cheaper at equal accuracy** | "
                 + " | ".join(f"**{median['exudyn', p] / median['hydroflex', p]:.1f}**" for p in PAYLOADS_KG) + " |")
    lines += ["", f"Against Exudyn with steps of {a.fine_s * 1e3:g} ms (lengths, velocities, pressures, angles, angular velocities, "
              "deflection; worst channel's median over the runs, and the largest of all runs and channels):", ""]
    lines += [f"* Exudyn `{s}` {h * 1e3:g} ms: median {e:.1e}, largest {m:.1e}" for s, h, e, m, _ in tried]
    lines.append(f"* hydroflex `accurate`: median {own[0]:.1e}, largest {own[1]:.1e} (its own friction of at most 2.5 N included)")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
