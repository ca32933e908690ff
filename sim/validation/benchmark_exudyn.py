#!/usr/bin/env python3
"""What a simulated second costs: hydroflex and Exudyn on the same boom, in turns, in one run of this script.

    pip install exudyn==1.13.6 scikit-fem numpy scipy pyarrow
    python sim/validation/benchmark_exudyn.py --out docs/benchmark-simulator.md

Both simulate sim/validation/lift-boom/boom.toml (the built-in boom with Exudyn's conventions) with random valve
signals of 1 s, sampled every 5 ms, on one thread. Figures are user CPU time, median over the rounds: a machine
that does other things disturbs them less than elapsed time, but compare the ratios.

Exudyn is driven in three ways:
  as published    what published scripts do: finite-element data read from a file in every run, every mesh node in
                  the model, connection points averaged over all nodes of their sets, friction in Python
  at its best     the same answer with the data in memory, one substitute node per connection point, no friction
  to 1e-3         the same with the largest step whose median error over the runs, in its worst channel, is
                  within 1e-3 of the channel's range (reference: Exudyn with steps of --fine-s)
"""
import argparse
import json
import math
import os
import pickle
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import tomllib
from datetime import date

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import exudyn as exu  # noqa: E402
from exudyn.FEM import ObjectFFRFreducedOrderInterface  # noqa: E402
from exudyn_lift_boom import Boom, simulate  # noqa: E402

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
MACHINE = os.path.join(ROOT, "sim/validation/lift-boom/boom.toml")
MESH = os.path.join(ROOT, "sim/machines/lift-boom/lift-boom.inp")
SAMPLE_S = 0.005
PAYLOADS_KG = (0.0, 50.0, 100.0)
STEPS_S = (5e-3, 2.5e-3, 1.25e-3, 1e-3, 6.25e-4, 5e-4, 2.5e-4)
SCHEMES = {"trapezoidal-index-2": "trapezoidal", "generalized-alpha": "generalized-alpha"}


def cpu_s():
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime


class KeptBoom(Boom):
    """Reduced once."""

    def __init__(self, machine, mesh):
        super().__init__(machine, mesh)
        self.fems = {}

    def fem(self, payload):
        if payload not in self.fems:
            self.fems[payload] = super().fem(payload)
        return self.fems[payload]


class PublishedBoom(Boom):
    """All mesh nodes in the model, finite-element data read anew for every run."""

    def __init__(self, boom, folder):
        self.__dict__.update(boom.__dict__)
        self.files = {}
        for payload in (False, True):
            self.files[payload] = os.path.join(folder, f"fem-{payload}.pickle")
            with open(self.files[payload], "wb") as file:
                pickle.dump(boom.fem(payload), file)

    def interface(self, payload):
        with open(self.files[payload], "rb") as file:
            fem = pickle.load(file)
        return ObjectFFRFreducedOrderInterface(fem), [i["name"] for i in self.body["interface"]] + ["tip"]

    def attachment(self, name, names):
        if name == "tip":
            return [self.tip], [1.0]
        nodes = self.sets[name]
        spec = next(i for i in self.body["interface"] if i["name"] == name)
        return nodes.tolist(), self.weights(spec, nodes).tolist()


def random_runs(count, payload_kg, seed):
    """The paper's signal: a fifth each of full open, full shut, closed, ramps and noise, in random order."""
    draw = np.random.default_rng([seed, int(payload_kg)])
    runs = []
    for k in range(count):
        ramps = np.concatenate([np.linspace(*draw.uniform(-1, 1, 2), 8) for _ in range(5)])
        blocks = [np.ones(40), -np.ones(40), np.zeros(40), ramps, draw.uniform(-1, 1, 40)]
        draw.shuffle(blocks)
        runs.append({"run_id": k, "payload_kg": payload_kg, "angle_lift_rad": math.radians(draw.uniform(5, 30)),
                     "valve_lift_ratio": np.concatenate(blocks).tolist()})
    return runs


def exudyn_run(boom, run, scheme, step_s, python_spring):
    """Channels, user CPU of the whole run, and of the time integration alone."""
    integration = []

    def measure(integrate):
        start = cpu_s()
        integrate()
        integration.append(cpu_s() - start)

    start = cpu_s()
    channels = simulate(boom, run, scheme, step_s, SAMPLE_S, python_spring=python_spring, measure=measure)
    return channels, cpu_s() - start, integration[0]


CHANNELS = ("length_lift_m", "velocity_lift_m_per_s", "pressure_lift_piston_pa", "pressure_lift_rod_pa",
            "angle_lift_rad", "angular_velocity_lift_rad_per_s", "deflection_tip_y_m")


def median_error(runs, reference):
    """Median over the runs of the largest error, over the channel's median range; the worst channel's."""
    worst = 0.0
    for c in CHANNELS:
        scale = statistics.median(float(np.ptp(r[c])) for r in reference)
        off = [float(np.max(np.abs(a[c] - b[c]))) / scale for a, b in zip(runs, reference)]
        worst = max(worst, statistics.median(off))
    return worst


def cheapest_step(boom, runs, scheme, fine_s):
    """The largest step with a median error within 1e-3, and what each tried step gives."""
    reference = [exudyn_run(boom, r, scheme, fine_s, False)[0] for r in runs]
    tried = []
    for step_s in STEPS_S:
        error = median_error([exudyn_run(boom, r, scheme, step_s, False)[0] for r in runs], reference)
        tried.append((step_s, error))
        print(f"  step {step_s * 1e3:g} ms: median error {error:.1e}", flush=True)
        if error <= 1e-3:
            return step_s, tried
    return STEPS_S[-1], tried


def ours(command):
    """One line per payload of the Rust benchmark."""
    out = subprocess.run([*command, "--json", "--machine", MACHINE, "--mesh", MESH], cwd=ROOT, check=True,
                         capture_output=True, text=True).stdout
    lines = [json.loads(line) for line in out.splitlines() if line.startswith("{")]
    return {line["payload_kg"]: line for line in lines}


def processor():
    try:
        for line in open("/proc/cpuinfo"):
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", help="write the table to this Markdown file (default: standard output)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--runs", type=int, default=3, help="random runs per payload for Exudyn (default: 3)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fine-s", type=float, default=1e-4, help="Exudyn's step for the reference (default: 1e-4)")
    parser.add_argument("--bench", help="the built benchmark program instead of "
                                        "`cargo bench -p hydroflex-sim --bench accurate --`")
    a = parser.parse_args()
    command = [a.bench] if a.bench else ["cargo", "bench", "-q", "-p", "hydroflex-sim", "--bench", "accurate", "--"]
    machine = tomllib.load(open(MACHINE, "rb"))
    scheme = "trapezoidal-index-2"
    runs = {p: random_runs(a.runs, p, a.seed) for p in PAYLOADS_KG}
    best = KeptBoom(machine, MESH)
    with tempfile.TemporaryDirectory() as folder:
        published = PublishedBoom(best, folder)
        steps, errors = {}, {}
        for p in PAYLOADS_KG:
            print(f"{p:g} kg", flush=True)
            steps[p], errors[p] = cheapest_step(best, runs[p], scheme, a.fine_s)
        cost = {}  # (row, payload) -> CPU seconds, one per measurement

        def note(row, p, seconds):
            cost.setdefault((row, p), []).append(seconds)

        for k in range(a.rounds):
            print(f"round {k + 1} of {a.rounds}", flush=True)
            rust = ours(command)
            for p in PAYLOADS_KG:
                for row in ("trapezoidal", "generalized_alpha", "alone", "batch"):
                    note(row, p, rust[p][f"{row}_us"] * 1e-6)
                note("as published", p, exudyn_run(published, runs[p][0], scheme, SAMPLE_S, True)[1])
                for run in runs[p]:
                    _, whole, integration = exudyn_run(best, run, scheme, SAMPLE_S, False)
                    note("best", p, integration)
                    note("best, whole run", p, whole)
                    note("to 1e-3", p, exudyn_run(best, run, scheme, steps[p], False)[2])
    median = {key: statistics.median(values) for key, values in cost.items()}
    text = table(a, median, steps, errors, rust[0.0]["instruction_set"], machine["name"])
    if a.out:
        open(a.out, "w").write(text)
    else:
        print(text)


def table(a, median, steps, errors, instruction_set, name):
    rows = [
        ("Exudyn, as published scripts drive it (whole run)", "as published"),
        ("Exudyn at its best, 5 ms (whole run)", "best, whole run"),
        ("Exudyn at its best, 5 ms (time integration)", "best"),
        ("Exudyn at its best, median error within 1e-3 (time integration)", "to 1e-3"),
        ("hydroflex `trapezoidal-index-2`, 5 ms", "trapezoidal"),
        ("hydroflex `generalized-alpha`, 5 ms", "generalized_alpha"),
        ("hydroflex `accurate` (tolerance 1e-3), alone", "alone"),
        ("hydroflex `accurate` (tolerance 1e-3), in a batch, per run and core", "batch"),
    ]
    milliseconds = lambda row, p: f"{median[row, p] * 1e3:.3g}"
    lines = [
        "# What a simulated second costs",
        "",
        f"Written by `python sim/validation/benchmark_exudyn.py --rounds {a.rounds} --runs {a.runs} --seed {a.seed} --fine-s {a.fine_s:g}` on "
        f"{date.today().isoformat()}: {processor()}, {os.cpu_count()} cores, {platform.system()}, "
        f"{instruction_set} instructions in the batch; Exudyn {exu.__version__}, Python {platform.python_version()}, "
        f"NumPy {np.__version__}. Load average at the end {os.getloadavg()[0]:.0f}; other programs slow both, "
        "so compare the ratios.",
        "",
        f"Machine: `sim/validation/lift-boom/boom.toml` (`{name}`), random valve signals of 1 s, samples every 5 ms, "
        "one thread. Milliseconds of user CPU per run, medians, hydroflex and Exudyn in turns. Reducing the body "
        "is in none of the rows, equilibrium and recording of all channels in all of hydroflex's.",
        "",
        "| | 0 kg | 50 kg | 100 kg |",
        "|---|---|---|---|",
    ]
    for title, row in rows:
        lines.append(f"| {title} | " + " | ".join(milliseconds(row, p) for p in PAYLOADS_KG) + " |")
    ratio = lambda x, y, p: f"{median[x, p] / median[y, p]:.0f}"
    lines += ["", "How many times cheaper:", "", "| | 0 kg | 50 kg | 100 kg |", "|---|---|---|---|"]
    for title, x, y in [
        ("`trapezoidal-index-2`, than Exudyn at its best (time integration)", "best", "trapezoidal"),
        ("`trapezoidal-index-2`, than Exudyn as published", "as published", "trapezoidal"),
        ("`accurate` alone, than Exudyn at its best to 1e-3", "to 1e-3", "alone"),
        ("`accurate` in a batch, than Exudyn at its best to 1e-3", "to 1e-3", "batch"),
    ]:
        lines.append(f"| {title} | " + " | ".join(ratio(x, y, p) for p in PAYLOADS_KG) + " |")
    lines += ["", f"Median error of Exudyn at its best over {a.runs} runs, worst of length, velocity, pressures, angle, angular "
              f"velocity and deflection, against Exudyn with steps of {a.fine_s * 1e3:g} ms:", ""]
    for p in PAYLOADS_KG:
        lines.append(f"* {p:g} kg: " + ", ".join(f"{e:.1e} at {s * 1e3:g} ms" for s, e in errors[p])
                     + f"; taken: {steps[p] * 1e3:g} ms")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
