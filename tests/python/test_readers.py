"""A data set opens in the tools people have, each with one line, and every tool reads the same numbers.

pyarrow, pandas, polars, DuckDB, Hugging Face `datasets` (local), mlcroissant; and over HTTP one column of one run
without fetching the file. The data set is made here by `hydroflex simulate` on the built-in boom.
"""
import functools
import hashlib
import http.server
import json
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import threading

import duckdb
import numpy as np
import pandas
import polars
import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet as pq

RUNS, STEPS, SHORT_STEPS = 40, 1000, 25
COLUMN = "deflection_tip_y_m"


def make(scratch):
    """Runs of the built-in boom, one of them shorter, one with a payload."""
    def signal(run, steps):
        return [math.sin(0.05 * (run + 1) * k) for k in range(steps)]
    steps = [SHORT_STEPS if run == 3 else STEPS for run in range(RUNS)]
    table = pa.table({
        "run_id": pa.array([10 * run for run in range(RUNS)], pa.uint64()),
        "payload_kg": pa.array([50.0 if run == 4 else 0.0 for run in range(RUNS)]),
        "angle_lift_rad": pa.array([0.01 * run for run in range(RUNS)]),
        "valve_lift_ratio": pa.array([signal(run, n) for run, n in enumerate(steps)], pa.list_(pa.float64())),
    })
    runs, out = scratch / "runs.parquet", scratch / "set"
    pq.write_table(table, runs)
    summary = subprocess.run([os.environ["HYDROFLEX_BIN"], "simulate", "--runs", runs, "--out", out, "--json",
                              "--integrator", "trapezoidal-index-2"], check=True, capture_output=True, text=True)
    summary = json.loads(summary.stdout)
    assert summary["runs"]["ok"] == RUNS, summary
    assert summary["dataset_sha256"] == hashlib.sha256((out / "SHA256SUMS").read_bytes()).hexdigest()
    return out, sum(steps) + RUNS


def check_files(out, rows):
    sums = dict(reversed(line.split("  ")) for line in (out / "SHA256SUMS").read_text().splitlines())
    on_disk = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}
    assert on_disk == sums.keys() | {"SHA256SUMS"}, on_disk ^ sums.keys()
    for path, sha256 in sums.items():
        assert hashlib.sha256((out / path).read_bytes()).hexdigest() == sha256, path
    manifest = json.loads((out / "manifest.json").read_text())
    assert sum(f["rows"] for f in manifest["files"] if f["path"].startswith("data/")) == rows


def check_parquet(out):
    """What the layout promises of each file."""
    for path in sorted(out.glob("data/*.parquet")):
        file = pq.ParquetFile(path)
        names = file.schema_arrow.names
        assert names[:4] == ["run_id", "step", "time_s", "valve_lift_ratio"], names
        field = file.schema_arrow.field(COLUMN)
        assert field.type == pa.float64()
        metadata = {k.decode(): v.decode() for k, v in field.metadata.items()}
        assert (metadata["unit"], metadata["quantity"]) == ("m", "deflection") and metadata["frame"], metadata
        key_values = file.metadata.metadata
        assert {b"hydroflex.version", b"hydroflex.machine_sha256", b"hydroflex.instruction_set"} <= key_values.keys()
        for group in range(file.metadata.num_row_groups):
            for index in range(file.metadata.num_columns):
                chunk = file.metadata.row_group(group).column(index)
                assert chunk.compression == "ZSTD" and chunk.is_stats_set and chunk.has_offset_index, chunk
                if chunk.path_in_schema == COLUMN:
                    assert "BYTE_STREAM_SPLIT" in chunk.encodings, chunk.encodings
        ids = file.read(["run_id", "step"]).to_pandas()
        assert ids.equals(ids.sort_values(["run_id", "step"], ignore_index=True))


def one_line_each(out):
    """The same column, run by run, from each tool."""
    from datasets import load_dataset
    hub = load_dataset(str(out), cache_dir=str(out.parent / "cache"))
    return {
        "pyarrow": pyarrow.dataset.dataset(out / "data").to_table().to_pandas(),
        "pandas": pandas.read_parquet(out / "data"),
        "polars": polars.scan_parquet(out / "data/*.parquet").collect().to_pandas(),
        "duckdb": duckdb.sql(f"select * from '{out}/data/*.parquet'").df(),
        "datasets": pandas.concat(split.to_pandas() for split in hub.values()),
    }


def check_readers(out, rows):
    tables = {name: table.sort_values(["run_id", "step"], ignore_index=True)
              for name, table in one_line_each(out).items()}
    reference = tables["pyarrow"]
    assert len(reference) == rows
    for name, table in tables.items():
        for column in reference.columns:
            assert np.array_equal(table[column].to_numpy(), reference[column].to_numpy()), (name, column)
        print(f"  {name}: {len(table)} rows, {len(table.columns)} columns")
    runs = pandas.read_parquet(out / "meta/runs.parquet")
    assert list(runs.run_id) == [10 * run for run in range(RUNS)]
    assert set(runs.solver_path) == {"trapezoidal-index-2"}
    assert set(runs.status) == {"ok"} and runs.reason.isna().all() and all(len(flags) <= 5 for flags in runs["flags"])
    counts = reference.groupby("run_id").size()
    assert counts[30] == SHORT_STEPS + 1 and counts[0] == STEPS + 1


def check_statistics(out):
    reference = pandas.read_parquet(out / "data")
    for name, s in json.loads((out / "meta/stats.json").read_text())["all"].items():
        x = reference[name].to_numpy()
        spread = max(np.ptp(x), 1e-300)
        assert s["count"] == len(x) and s["min"] == x.min() and s["max"] == x.max(), name
        # numpy sums pairwise, we run by run: rounding only
        assert abs(s["mean"] - x.mean()) < 1e-9 * max(spread, abs(x.mean())), name
        assert abs(s["std"] - x.std()) < 1e-9 * max(spread, abs(x.mean())), name
        assert abs(s["rms"] - np.sqrt((x ** 2).mean())) < 1e-9 * np.abs(x).max() + 1e-300, name


def check_croissant(out):
    import mlcroissant
    dataset = mlcroissant.Dataset(jsonld=out / "croissant.json")
    assert not dataset.metadata.issues.errors, dataset.metadata.issues.report()
    record_sets = [record_set.uuid for record_set in dataset.metadata.record_sets]
    assert "meta/runs" in record_sets and any(name.startswith("data/train") for name in record_sets), record_sets
    record = next(iter(dataset.records(next(name for name in record_sets if name.startswith("data/train")))))
    assert any(key.endswith(COLUMN) for key in record), record
    assert not any("context" in warning for warning in dataset.metadata.issues.warnings)
    print(f"  mlcroissant: {len(record_sets)} record sets, {len(dataset.metadata.issues.warnings)} warnings")


class RangeHandler(http.server.SimpleHTTPRequestHandler):
    """Serves byte ranges and counts what it sends."""
    sent = 0

    def log_message(self, *_):
        pass

    def do_GET(self):
        body = pathlib.Path(self.translate_path(self.path)).read_bytes()
        start, end = 0, len(body) - 1
        asked = self.headers.get("Range")
        if asked:
            first, last = asked.removeprefix("bytes=").split("-")
            start = int(first) if first else max(0, len(body) - int(last))
            end = min(int(last), end) if first and last else end
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(end - start + 1))
        if asked:
            self.send_header("Content-Range", f"bytes {start}-{end}/{len(body)}")
        self.send_header("Accept-Ranges", "bytes")
        self.end_headers()
        self.wfile.write(body[start:end + 1])
        RangeHandler.sent += end - start + 1


def check_http(out):
    """Whole by URL with pandas; one column of one run with polars, which fetches only part of the file."""
    handler = functools.partial(RangeHandler, directory=out)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    file = sorted(out.glob("data/train-*.parquet"))[0]
    url = f"http://127.0.0.1:{server.server_port}/data/{file.name}"
    local = pandas.read_parquet(file)
    assert pandas.read_parquet(url).equals(local)
    RangeHandler.sent = 0
    remote = polars.scan_parquet(url).filter(polars.col("run_id") == 10).select(COLUMN).collect()
    server.shutdown()
    assert np.array_equal(remote[COLUMN].to_numpy(), local[local.run_id == 10][COLUMN].to_numpy())
    print(f"  one column of one run by URL: {RangeHandler.sent} of {file.stat().st_size} bytes")
    assert RangeHandler.sent < file.stat().st_size


def main():
    with tempfile.TemporaryDirectory() as scratch:
        os.environ["HF_HUB_OFFLINE"] = "1"
        os.environ["HF_HOME"] = str(pathlib.Path(scratch) / "hf")
        out, rows = make(pathlib.Path(scratch))
        check_files(out, rows)
        check_parquet(out)
        check_readers(out, rows)
        check_statistics(out)
        check_croissant(out)
        check_http(out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
