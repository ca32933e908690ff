"""Part of the true values inside the 90 % intervals of models, on a data set that none of them has seen: whole, by thirds of amplitude, by payload.

    python tests/bench/coverage.py --data SET --target deflection_tip_y_m MODEL [MODEL …]

Runs with a flag (end stop, cavitation, beyond supply pressure) are left out, as in calibration.
"""

import argparse
import os
import pathlib
import subprocess
import tempfile

import numpy
import pyarrow
import pyarrow.parquet

EDGES_KG = (0, 25, 50, 75, 95, 100)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=pathlib.Path)
    parser.add_argument("--data", required=True, type=pathlib.Path)
    parser.add_argument("--target", default="deflection_tip_y_m")
    arguments = parser.parse_args()
    meta = pyarrow.parquet.read_table(arguments.data / "meta" / "runs.parquet").to_pydict()
    calm = {run for run, flags in zip(meta["run_id"], meta["flags"]) if not flags}
    payload_kg = dict(zip(meta["run_id"], meta["payload_kg"]))
    files = sorted((arguments.data / "data").rglob("*.parquet"))
    truth = in_order(pyarrow.concat_tables(pyarrow.parquet.read_table(file, columns=["run_id", "step", arguments.target]) for file in files))
    for model in arguments.models:
        report(model, arguments, truth, calm, payload_kg)


def in_order(table):
    return table.sort_by([("run_id", "ascending"), ("step", "ascending")])


def report(model, arguments, truth, calm, payload_kg):
    with tempfile.TemporaryDirectory() as folder:
        out = pathlib.Path(folder) / "estimates.parquet"
        binary = os.environ.get("HYDROFLEX_BIN", "target/release/hydroflex")
        subprocess.run([binary, "predict", "--model", model, "--data", arguments.data, "--out", out], check=True, capture_output=True)
        found = in_order(pyarrow.parquet.read_table(out))
    column = lambda table, name: table[name].to_numpy(zero_copy_only=False).astype(float)
    run = truth["run_id"].to_numpy()
    assert (run == found["run_id"].to_numpy()).all(), "the same runs"
    true = column(truth, arguments.target)
    lower, upper = (column(found, f"{arguments.target}_{end}") for end in ("lower", "upper"))
    judged = numpy.isin(run, list(calm)) & ~numpy.isnan(lower)
    inside = ((lower <= true) & (true <= upper))[judged]
    amplitude = numpy.abs(true[judged] - true[judged].mean())
    payload = numpy.array([payload_kg[run] for run in run[judged]])
    thirds = [part.mean() for part in numpy.array_split(inside[amplitude.argsort()], 3)]
    print(f"{model}: {len(set(run[judged]))} runs, {inside.mean():.1%} inside; thirds {', '.join(f'{part:.1%}' for part in thirds)}")
    kinds = {"0 kg": payload == 0}
    kinds |= {f"{low}-{high} kg": (payload > low) & (payload <= high) for low, high in zip(EDGES_KG, EDGES_KG[1:])}
    for name, some in kinds.items():
        if some.any():
            print(f"    {name}: {inside[some].mean():.1%} of {len(set(run[judged][some]))} runs")


if __name__ == "__main__":
    main()
