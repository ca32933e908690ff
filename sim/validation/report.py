#!/usr/bin/env python3
"""Validation report: hydroflex against other people's solvers, one table and plots.

    pip install numpy pyarrow matplotlib
    cargo build --release && python sim/validation/report.py

writes docs/validation.md and its pictures. What is always there: the built-in boom against Exudyn (committed runs,
see exudyn_lift_boom.py). With HYDROFLEX_REFERENCE naming the reference data: all runs of the published boom and of the
two-cylinder crane. Differences are relative to the range of the channel: of the run for the built-in boom, and the median
range over the regular random runs of that payload for the reference data, as their own judge does it.
"""
import argparse
import math
import os
import pathlib
import subprocess
import tempfile

import matplotlib
import numpy as np
import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet as pq

matplotlib.use("svg")
import matplotlib.pyplot as plt  # noqa: E402  (the backend is chosen first)

ROOT = pathlib.Path(__file__).resolve().parents[2]
BUILT_IN = ROOT / "sim" / "validation" / "lift-boom"

LIFT_BOOM = {  # reference column -> ours
    "s": "length_lift_m", "ds": "velocity_lift_m_per_s", "p1": "pressure_lift_piston_pa", "p2": "pressure_lift_rod_pa",
    "F_cyl": "force_lift_n", "theta": "angle_lift_rad", "dtheta": "angular_velocity_lift_rad_per_s",
    "ddtheta": "angular_acceleration_lift_rad_per_s2", "delta_y": "deflection_tip_y_m", "eps_xy": "strain_tip_xy",
    "sigma_xx": "stress_root_xx_pa"}
CRANE = {
    "s1": "length_lift_m", "ds1": "velocity_lift_m_per_s", "p1": "pressure_lift_piston_pa", "p2": "pressure_lift_rod_pa",
    "s2": "length_tilt_m", "ds2": "velocity_tilt_m_per_s", "p3": "pressure_tilt_piston_pa", "p4": "pressure_tilt_rod_pa",
    "theta1": "angle_lift_rad", "theta2": "angle_tilt_rad", "delta_y": "deflection_tip_y_m",
    "dtheta1": "angular_velocity_lift_rad_per_s", "dtheta2": "angular_velocity_tilt_rad_per_s",
    "eps1": "strain_lift_xy", "sig1": "stress_lift_xx_pa", "eps2": "strain_tilt_xy", "sig2": "stress_tilt_xx_pa"}
SCHEMES = {"trapezoidal-index-2": ("a", "same scheme, 5 ms"), "generalized-alpha": ("b", "same scheme, 5 ms"),
           "accurate": ("c", "converged")}
# machine -> (folder of the reference data, columns, angles {column: ours}, signals, meshes)
MACHINES = {
    "lift-boom-published": ("liftboom", LIFT_BOOM, {"theta_in": "lift"}, {"U": "lift"}, ["Job-1.inp"]),
    "crane-published": ("patu", CRANE, {"theta1_in": "lift", "theta2_in": "tilt"}, {"U1": "lift", "U2": "tilt"},
                        ["lift=LiftBoom-Job-1.inp", "tilt=TiltBoom-Job-1.inp"]),
}

REMARKS = {
    "crane-published": "Runs in which a valve opens start from the loosely converged static solution that the machine file asks for, as the "
                       "reference's do: started exactly at rest, the tilt boom's stress would differ by up to 2.2e-3. The two hold runs start at rest: "
                       "the reference's tip drifts by 7.0e-7 and 6.9e-7 m there.",
}


def simulate(binary, machine, meshes, runs, out, scheme):
    """One call of `hydroflex simulate`; returns {run: {column: samples}} and the rows of runs.parquet."""
    command = [binary, "simulate", "--machine", machine, "--runs", runs, "--out", out, "--integrator", scheme]
    for mesh in meshes:
        command += ["--mesh", mesh]
    subprocess.run(command, check=True)
    table = pyarrow.dataset.dataset(pathlib.Path(out) / "data").to_table().to_pandas().sort_values(["run_id", "step"])
    return {int(r): g for r, g in table.groupby("run_id")}, pq.read_table(pathlib.Path(out) / "meta" / "runs.parquet").to_pandas()


def number(value):
    return f"{value:.1e}" if np.isfinite(value) else "–"


def table(header, rows):
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(map(str, row)) + " |" for row in rows])


def built_in(binary, docs):
    """The built-in boom against Exudyn on our mesh."""
    theirs = pq.read_table(BUILT_IN / "exudyn.parquet").to_pandas()
    with tempfile.TemporaryDirectory() as scratch:
        ours, _ = simulate(binary, BUILT_IN / "boom.toml", [ROOT / "sim/machines/lift-boom/lift-boom.inp"],
                           BUILT_IN / "runs.parquet", pathlib.Path(scratch) / "set", "accurate")
    columns = [c for c in theirs.columns if c not in ("run_id", "step", "time_s", "deflection_tip_z_m")]
    rows = []
    for column in columns:
        largest, rms = [], []
        for run, t in theirs.groupby("run_id"):
            t = t.sort_values("step")
            difference = ours[int(run)][column].to_numpy() - t[column].to_numpy()
            span = np.ptp(t[column].to_numpy())
            largest.append(np.abs(difference).max() / span)
            rms.append(math.sqrt(np.mean(difference**2)) / span)
        rows.append([f"`{column}`", number(max(largest)), number(max(rms))])
    run = int(theirs.run_id.max())
    t = theirs[theirs.run_id == run].sort_values("step")
    figure, axes = plt.subplots(4, 1, figsize=(8, 7), sharex=True, height_ratios=[3, 1.2, 3, 1.2], constrained_layout=True)
    for top, bottom, column, unit, factor in ((0, 1, "deflection_tip_y_m", "mm", 1e3), (2, 3, "pressure_lift_piston_pa", "bar", 1e-5)):
        mine, reference = ours[run][column].to_numpy() * factor, t[column].to_numpy() * factor
        axes[top].plot(t.time_s, reference, color="0.25", lw=2.2, label="Exudyn (scikit-fem mesh assembly)")
        axes[top].plot(t.time_s, mine, color="C1", lw=1, label="hydroflex, accurate")
        axes[top].set_ylabel(f"{column.rsplit('_', 1)[0]}\n[{unit}]")
        axes[bottom].plot(t.time_s, mine - reference, color="C3", lw=0.8)
        axes[bottom].set_ylabel(f"difference\n[{unit}]")
        axes[bottom].ticklabel_format(axis="y", style="sci", scilimits=(-2, 2))
    axes[0].legend(frameon=False, fontsize=8)
    axes[-1].set_xlabel("time [s]")
    axes[0].set_title(f"Built-in boom, run {run}", fontsize=10)
    figure.savefig(docs / "validation-built-in.svg", metadata={"Date": None})
    plt.close(figure)
    return table(["channel", "largest of range", "rms of range"], rows), len(theirs.run_id.unique())


class Reference:
    def __init__(self, folder):
        self.runs = pq.read_table(folder / "runs.parquet").to_pylist()
        self.samples = pq.read_table(folder / "trajectories.parquet").to_pandas()

    def one(self, run, solution):
        s = self.samples
        return s[(s.run == run) & (s.solution == solution)].sort_values("step")


def reference(binary, machine, root, docs):
    """All runs of the reference data with each scheme: table rows, picture, and runs that did not finish."""
    name, channels, angles, signals, meshes = MACHINES[machine]
    folder = pathlib.Path(root) / name
    ref = Reference(folder)
    meshes = [m.replace("=", f"={folder}/") if "=" in m else folder / m for m in meshes]
    inputs = {"run_id": pa.array([int(r["run"]) for r in ref.runs], pa.uint64()),
              "payload_kg": pa.array([float(r["payload"]) for r in ref.runs], pa.float64())}
    for column, element in angles.items():
        inputs[f"angle_{element}_rad"] = pa.array([math.radians(r[column]) for r in ref.runs], pa.float64())
    for column, element in signals.items():
        inputs[f"valve_{element}_ratio"] = pa.array(
            [ref.one(r["run"], "a")[column].to_numpy()[1:].astype(float).tolist() for r in ref.runs], pa.list_(pa.float64()))
    regular = [r for r in ref.runs if r["kind"] != "hold" and "stroke_cutoff_active" not in (r["flags"] or "")]
    results, unfinished = {}, []
    with tempfile.TemporaryDirectory() as scratch:
        runs = pathlib.Path(scratch) / "runs.parquet"
        pq.write_table(pa.table(inputs), runs)
        for scheme, (solution, _) in SCHEMES.items():
            ours, rows = simulate(binary, machine, meshes, runs, pathlib.Path(scratch) / scheme, scheme)
            unfinished += [(scheme, int(r.run_id), r.reason) for r in rows.itertuples() if r.status != "ok"]
            span = {}
            for r in regular:
                if r["kind"] == "random":
                    t = ref.one(r["run"], solution)
                    for c in channels:
                        span.setdefault((r["payload"], c), []).append(np.ptp(t[c].to_numpy()))
            for r in regular:
                if int(r["run"]) not in ours:
                    continue
                t = ref.one(r["run"], solution)
                for c, column in channels.items():
                    difference = ours[int(r["run"])][column].to_numpy() - t[c].to_numpy()
                    scale = max(float(np.median(span[(r["payload"], c)])), 1e-300)
                    results.setdefault((scheme, c), []).append(
                        (np.abs(difference).max() / scale, math.sqrt(np.mean(difference**2)) / scale, int(r["run"])))
    rows = []
    for c, column in channels.items():
        row = [f"`{column}`"]
        for scheme in SCHEMES:
            values = results[(scheme, c)]
            top = max(values)
            row += [number(float(np.median([v[0] for v in values]))), f"{number(top[0])} ({top[2]})",
                    number(math.sqrt(np.mean([v[1] ** 2 for v in values])))]
        rows.append(row)
    header = ["channel"] + [f"{s}: {q}" for s in SCHEMES for q in ("median", "largest (run)", "rms")]
    figure, axis = plt.subplots(figsize=(9, 5), constrained_layout=True)
    for shift, scheme, colour in zip((-0.22, 0, 0.22), SCHEMES, ("C0", "C2", "C1")):
        for x, c in enumerate(channels):
            values = [max(v[0], 1e-12) for v in results[(scheme, c)]]
            axis.plot([x + shift] * len(values), values, ".", color=colour, ms=3.5, alpha=0.6, mew=0,
                      label=f"{scheme} against {SCHEMES[scheme][1]}" if x == 0 else None)
    axis.set_yscale("log")
    axis.set_xticks(range(len(channels)), [c.rsplit("_", 1)[0] if c.endswith("_pa") else c for c in channels.values()], rotation=60, ha="right", fontsize=7)
    axis.set_ylabel("largest difference / range")
    axis.grid(axis="y", alpha=0.3)
    axis.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    figure.suptitle(f"{machine}: {len(regular)} runs, one point a run", fontsize=10)
    figure.savefig(docs / f"validation-{machine}.svg", metadata={"Date": None})
    plt.close(figure)
    return table(header, rows), len(regular), len(ref.runs), unfinished


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "docs")
    parser.add_argument("--machines", nargs="*", choices=MACHINES, default=list(MACHINES), help="of the reference data")
    arguments = parser.parse_args()
    binary = os.environ.get("HYDROFLEX_BIN", str(ROOT / "target" / "release" / "hydroflex"))
    docs = arguments.out
    docs.mkdir(parents=True, exist_ok=True)
    plt.rcParams["svg.hashsalt"] = "hydroflex"  # same data, same bytes
    body, count = built_in(binary, docs)
    text = ["# Validation", "",
            "Made by `python sim/validation/report.py`; its head says what is compared and how.", "",
            "## The built-in boom against Exudyn", "",
            f"{count} runs of 1 s, our mesh assembled by scikit-fem, reduced and integrated by Exudyn 1.13.6 (0.2 ms), against "
            "`accurate`. Largest and rms difference over the runs, relative to the run's range.", "", body, "",
            "![Deflection and piston pressure of one run, with the differences](validation-built-in.svg)", ""]
    root = os.environ.get("HYDROFLEX_REFERENCE")
    if root:
        for machine in arguments.machines:
            body, judged, total, unfinished = reference(binary, machine, root, docs)
            text += [f"## `{machine}` against an independent solver", "",
                     f"{judged} of {total} runs are judged (hold runs stand still, and while the stroke cut-off acts the valve "
                     "chatters). Largest difference over a run relative to the channel's median range: median and largest "
                     "over the runs; rms over all samples.", "", body, "",
                     *([REMARKS[machine], ""] if machine in REMARKS else []),
                     f"![One point a run and channel](validation-{machine}.svg)", ""]
            if unfinished:
                text += ["Runs that did not finish: " + "; ".join(f"{s}, run {r}: {why}" for s, r, why in unfinished) + ".", ""]
    else:
        text += ["HYDROFLEX_REFERENCE was not set: the published boom and the crane were not compared.", ""]
    (docs / "validation.md").write_text("\n".join(text))
    print(f"{docs / 'validation.md'} written")


if __name__ == "__main__":
    main()
