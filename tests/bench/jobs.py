"""What a job costs beside the simulation itself: two workers of a service and two independent
`hydroflex simulate` processes on half of the runs each, side by side, in turn; what a worker's time goes into;
and what the samples take on disk, beside a pickle of NumPy arrays.

    cargo build --release
    python3 -m venv target/bench-venv
    target/bench-venv/bin/pip install numpy pyarrow
    target/bench-venv/bin/python tests/bench/jobs.py --out docs/benchmark-jobs.md

Two processes on two cores of a shared machine are not twice one: only what runs in the same minute is
compared, and the median over the rounds is shown.
"""

import argparse
import json
import os
import pathlib
import pickle
import re
import statistics
import subprocess
import tempfile
import time
import urllib.request

import numpy
import pyarrow
import pyarrow.parquet


class Service:
    """A service with two workers on an empty directory, and caches of its own."""

    def __init__(self, binary, folder):
        self.process = subprocess.Popen(
            [binary, "serve", "--listen", "127.0.0.1:0", "--workers", "2", "--data", folder],
            stderr=subprocess.PIPE,
            text=True,
        )
        for line in self.process.stderr:
            found = re.search(r'url="([^"]+)"', line)
            if found:
                self.url = found.group(1)
                break
        # The log must not fill its pipe.
        import threading

        threading.Thread(target=lambda: [None for _ in self.process.stderr], daemon=True).start()

    def get(self, path):
        with urllib.request.urlopen(self.url + path) as answer:
            return json.load(answer)

    def job(self, spec):
        """Runs a job; seconds from the request to the published data set, and its status."""
        begun = time.monotonic()
        request = urllib.request.Request(
            self.url + "/v1/jobs", json.dumps(spec).encode(), {"content-type": "application/json"}
        )
        with urllib.request.urlopen(request) as answer:
            job = json.load(answer)["job_id"]
        while True:
            status = self.get(f"/v1/jobs/{job}")
            if status["state"] in ("succeeded", "failed", "cancelled"):
                break
            time.sleep(0.01)
        assert status["state"] == "succeeded", status
        return time.monotonic() - begun, status

    def stop(self):
        self.process.terminate()
        self.process.wait()


def run_tables(data, folder, parts):
    """The runs of a data set as tables for `hydroflex simulate`, in equal parts."""
    runs = pyarrow.parquet.read_table(data / "meta/runs.parquet", columns=["run_id", "payload_kg", "angle_lift_rad"])
    files = sorted((data / "data").glob("*.parquet"))
    columns = ["run_id", "step", "valve_lift_ratio"]
    samples = pyarrow.concat_tables(pyarrow.parquet.read_table(file, columns=columns) for file in files)
    ids, steps = samples["run_id"].to_numpy(), samples["step"].to_numpy()
    valve = samples["valve_lift_ratio"].to_numpy()[steps > 0]
    ids = ids[steps > 0]
    signals = dict(zip(ids[:: len(ids) // len(numpy.unique(ids))], numpy.split(valve, len(numpy.unique(ids)))))
    rows = [row for row in runs.to_pylist() if row["run_id"] in signals]
    paths = []
    for part in range(parts):
        some = rows[part::parts]
        table = pyarrow.table(
            {
                "run_id": [row["run_id"] for row in some],
                "payload_kg": [row["payload_kg"] for row in some],
                "angle_lift_rad": [row["angle_lift_rad"] for row in some],
                "valve_lift_ratio": pyarrow.array([signals[row["run_id"]] for row in some], pyarrow.list_(pyarrow.float64())),
            }
        )
        paths.append(folder / f"part-{part}.parquet")
        pyarrow.parquet.write_table(table, paths[-1])
    return paths


def side_by_side(binary, tables, out):
    begun = time.monotonic()
    processes = [
        subprocess.Popen([binary, "simulate", "--runs", table, "--out", f"{out}-{part}", "--threads", "1", "--json"], stdout=subprocess.DEVNULL)
        for part, table in enumerate(tables)
    ]
    for process in processes:
        assert process.wait() == 0
    return time.monotonic() - begun


def few(tables):
    """Tables of two runs each: what such a process takes before and after its runs, the reduction of the mesh above
    all, which a service has done before."""
    paths = []
    for table in tables:
        paths.append(table.with_name(f"few-{table.name}"))
        pyarrow.parquet.write_table(pyarrow.parquet.read_table(table).slice(0, 2), paths[-1])
    return paths


def sizes(data):
    """Bytes per sample of the published files, and of the same samples as the published scripts keep them."""
    files = sorted((data / "data").glob("*.parquet"))
    table = pyarrow.concat_tables(pyarrow.parquet.read_table(file) for file in files)
    channels = [name for name in table.column_names if name not in ("run_id", "step", "time_s")]
    samples = table.num_rows * len(channels)
    runs = numpy.stack([table[name].to_numpy() for name in channels], axis=1).reshape(-1, 201, len(channels))
    begun = time.monotonic()
    with tempfile.TemporaryFile() as file:
        pickle.dump({"data": list(runs)}, file)
        pickled = file.tell()
    return {
        "rows": table.num_rows,
        "channels": len(channels),
        "parquet": sum(file.stat().st_size for file in files) / samples,
        "pickle": pickled / samples,
        "pickle_rows_per_s": table.num_rows / (time.monotonic() - begun),
    }


def resident_mib(pid):
    with open(f"/proc/{pid}/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmRSS:")) / 1024


def huge(binary, folder, runs, simulated, spec):
    """A job of very many runs: time until it is accepted, and the coordinator's memory while its first runs are
    simulated. It is cancelled then."""
    service = Service(binary, folder)
    service.job({**spec, "runs": 200, "seed": 999})
    before = resident_mib(service.process.pid)
    begun = time.monotonic()
    request = urllib.request.Request(
        service.url + "/v1/jobs", json.dumps({**spec, "runs": runs}).encode(), {"content-type": "application/json"}
    )
    with urllib.request.urlopen(request) as answer:
        job = json.load(answer)["job_id"]
    accepted = time.monotonic() - begun
    rows = []
    for mark in [simulated * part // 5 for part in range(1, 6)]:
        while (done := service.get(f"/v1/jobs/{job}")["progress"]["runs_done"]) < mark:
            time.sleep(0.1)
        rows.append((done, resident_mib(service.process.pid)))
        print(rows[-1], flush=True)
    urllib.request.urlopen(urllib.request.Request(f"{service.url}/v1/jobs/{job}/cancel", b"", method="POST")).close()
    service.stop()
    text = [f"A job of {runs:,} runs is accepted within {accepted * 1e3:.0f} ms. Memory of its coordinator (resident; it writes the data set", "while the runs are simulated; two columns in float32):", ""]
    text += ["| runs simulated | before | " + " | ".join(f"{done:,}" for done, _ in rows) + " |", "|---|" + "---:|" * (len(rows) + 1)]
    text += [f"| MiB | {before:.0f} | " + " | ".join(f"{mib:.0f}" for _, mib in rows) + " |", ""]
    return text


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--binary", default="target/release/hydroflex")
    parser.add_argument("--runs", type=int, nargs="*", default=[2560, 20480])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--huge", type=int, default=10_000_000, help="runs of the job whose coordinator's memory is looked at; 0 for none")
    parser.add_argument("--huge-simulated", type=int, default=400_000, help="runs of it that are simulated; 5 kB of disk each")
    parser.add_argument("--out")
    arguments = parser.parse_args()
    binary = os.path.abspath(arguments.binary)
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        service = Service(binary, folder / "service")
        spec = {"machine": "lift-boom", "payload_kg": {"min": 1, "max": 100}, "settling_runs": 0}
        service.job({**spec, "runs": 200, "seed": 999})  # both have their reduced bodies at hand
        spent_rows = []
        for runs in arguments.runs:
            _, status = service.job({**spec, "runs": runs, "seed": 0})
            data = folder / f"data-{runs}"
            subprocess.run([binary, "dataset", "fetch", status["dataset_id"], "--url", service.url, "--out", data], check=True, stdout=subprocess.DEVNULL)
            tables = run_tables(data, folder, 2)
            ratios, ours, theirs, wholes = [], [], [], []
            for turn in range(arguments.rounds):
                seconds, status = service.job({**spec, "runs": runs, "seed": turn + 1})
                ours.append(seconds)
                whole = side_by_side(binary, tables, folder / f"alone-{runs}-{turn}")
                wholes.append(whole)
                theirs.append(whole - side_by_side(binary, few(tables), folder / f"few-{runs}-{turn}"))
                ratios.append(ours[-1] / theirs[-1])
                spent_rows.append((runs, status["progress"]["spent"]))
            literal = statistics.median(our / whole for our, whole in zip(ours, wholes))
            lines.append(
                (runs, statistics.median(ours), statistics.median(wholes), literal, statistics.median(theirs), statistics.median(ratios), min(ratios), max(ratios))
            )
            print(lines[-1], flush=True)
        size = sizes(folder / f"data-{arguments.runs[0]}")
        service.stop()
    text = ["# What a job costs beside the simulation", ""]
    text += ["Runs of 1 s of the built-in boom with 1 to 100 kg, 201 rows of all channels in float64, by `tests/bench/jobs.py`: two workers", "of a service, from the request to the published data set, against two `hydroflex simulate --threads 1` processes with half of the", "runs each, side by side. Each process reduces the mesh first, which the service has done before; the ratio is given with that and", "without it (less what two such processes take for two runs each). Medians; the rounds of both take turns. Load average at the", "end: " + f"{os.getloadavg()[0]:.0f}.", ""]
    text += ["| runs | service, 2 workers | rows per second | 2 processes | ratio | without reduction | ratio | lowest | highest |", "|---:|---:|---:|---:|---:|---:|---:|---:|---:|"]
    for runs, ours, whole, literal, theirs, ratio, low, high in lines:
        rate = runs * 201 / ours
        text.append(f"| {runs} | {ours:.2f} s | {rate:,.0f} | {whole:.2f} s | {literal:.2f} | {theirs:.2f} s | {ratio:.2f} | {low:.2f} | {high:.2f} |")
    text += ["", "What a worker's time goes into, per run (medians over the rounds):", "", "| runs | simulate | encode | put | wait |", "|---:|---:|---:|---:|---:|"]
    for runs in arguments.runs:
        of = lambda key: statistics.median(spent[key] / n for n, spent in spent_rows if n == runs) * 1e3
        text.append(f"| {runs} | {of('simulate_s'):.3f} ms | {of('encode_s'):.3f} ms | {of('put_s'):.3f} ms | {of('wait_s'):.3f} ms |")
    text += ["", f"On disk a float64 sample takes {size['parquet']:.2f} bytes in the published Parquet files ({size['channels']} channels), {size['pickle']:.2f} in a pickle of", f"NumPy arrays as the published scripts keep them, which writes {size['pickle_rows_per_s']:,.0f} rows per second of samples that are in memory already.", ""]
    if arguments.huge:
        with tempfile.TemporaryDirectory() as folder:
            # Few columns write little; how many runs a shard has does not depend on them.
            narrow = {**spec, "columns": ["valve_lift_ratio", "deflection_tip_y_m"], "sample_type": "float32"}
            text += huge(binary, pathlib.Path(folder), arguments.huge, arguments.huge_simulated, narrow)
    text = "\n".join(text)
    print(text)
    if arguments.out:
        pathlib.Path(arguments.out).write_text(text)


if __name__ == "__main__":
    main()
