"""Speed of predictions: our kernel beside onnxruntime in process, our service beside MLServer and
FastAPI + onnxruntime over HTTP, live sessions, long recordings.

    cargo build --release -p hydroflex-server --example serving_bench
    python3 -m venv target/bench-venv
    target/bench-venv/bin/pip install 'mlserver==1.7.1' 'uvloop<0.22' onnxruntime onnx fastapi uvicorn numpy pyarrow
    target/bench-venv/bin/python tests/bench/serving.py --out docs/benchmark-serving.md

Everything that is compared runs in turn, round after round, so that what else the machine does
meets everybody. Models have random weights: how long a network takes does not depend on them.
"""

import argparse
import http.client
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import textwrap
import time

import numpy

STRUCTURES = ["L", "RLR", "TLTLT", "TLSLTLSLT", "ELE", "best"]
BATCHES = [1, 64, 4096]
STEPS, INPUTS = 60, 5


class Bench:
    def __init__(self, binary, folder):
        self.binary, self.folder = binary, pathlib.Path(folder)
        for structure in STRUCTURES:
            subprocess.run([binary, "write", structure, self.folder / structure], check=True)
        self.kernel_process = subprocess.Popen([binary, "kernel"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def kernel(self, structure, batch, calls):
        self.kernel_process.stdin.write(f"{self.folder / structure} {batch} {calls}\n")
        self.kernel_process.stdin.flush()
        return [float(word) for word in self.kernel_process.stdout.readline().split()]

    def close(self):
        self.kernel_process.stdin.close()
        self.kernel_process.wait()


def plain_onnx(folder):
    """The network alone, f32 in and out, as an exporter would write it: onnxruntime's best case."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    config = json.loads((folder / "config.json").read_text())
    tensors = safetensors(folder / "model.safetensors")
    nodes, constants, x = [], [], "x"

    def gemm(prefix, x, out):
        for part in ("weight", "bias"):
            constants.append(numpy_helper.from_array(tensors[f"{prefix}.{part}"], f"{prefix}.{part}"))
        nodes.append(helper.make_node("Gemm", [x, f"{prefix}.weight", f"{prefix}.bias"], [out], transB=1))

    for layer in config["layers"]:
        name = layer["name"]
        gemm(name, x, name)
        x = name
        for place, activation in enumerate(layer["activations"]):
            out = f"{name}.a{place}"
            operator = {"tanh": "Tanh", "sigmoid": "Sigmoid", "relu": "Relu", "elu": "Elu"}.get(activation)
            if operator:
                nodes.append(helper.make_node(operator, [x], [out]))
            else:
                assert activation == "silu", activation
                nodes.append(helper.make_node("Sigmoid", [x], [out + "s"]))
                nodes.append(helper.make_node("Mul", [x, out + "s"], [out]))
            x = out
    assert "schedule" not in config, "coefficients that follow signals are not part of this comparison"
    if config["linear_skip"]:
        gemm("skip", "x", "linear")
        nodes.append(helper.make_node("Add", [x, "linear"], ["sum"]))
        x = "sum"
    values = config["window_steps"] * len(config["inputs"])
    graph = helper.make_graph(
        nodes, "plain",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["batch", values])],
        [helper.make_tensor_value_info(x, TensorProto.FLOAT, ["batch", len(config["targets"])])],
        constants,
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()


def safetensors(path):
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    head = json.loads(content[8:8 + length])
    return {
        name: numpy.frombuffer(content[8 + length:], kind, (e - b) // kind.itemsize, b)
        .reshape(entry["shape"]).astype(numpy.float32)
        for name, entry in head.items() if name != "__metadata__"
        for kind in [numpy.dtype({"F32": "<f4", "F64": "<f8"}[entry["dtype"]])]
        for b, e in [entry["data_offsets"]]
    }


def in_process(bench, rounds):
    """µs of CPU per call: our network, onnxruntime's, our whole prediction, model.onnx with its scales."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    # A thread that waits by spinning would slow everything beside it.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    rows = []
    for structure in STRUCTURES:
        folder = bench.folder / structure
        plain = onnxruntime.InferenceSession(plain_onnx(folder), options, providers=["CPUExecutionProvider"])
        whole = onnxruntime.InferenceSession((folder / "model.onnx").read_bytes(), options, providers=["CPUExecutionProvider"])
        for batch in BATCHES:
            calls = max(4, int(40_000 / (5 + 0.8 * batch)))
            x = numpy.random.default_rng(1).standard_normal((batch, STEPS * INPUTS)).astype(numpy.float32)
            window = numpy.tile(numpy.array([0, 1.05, 0, 5e6, 4e6]), (batch, STEPS, 1)).astype(numpy.float64)

            def time_of(session, feed):
                names = [output.name for output in session.get_outputs()][:1]
                begun = time.thread_time()
                for _ in range(calls):
                    session.run(names, feed)
                return (time.thread_time() - begun) / calls * 1e6

            samples = []
            for round_ in range(rounds + 1):
                network, prediction = bench.kernel(structure, batch, calls)
                found = (network, time_of(plain, {"x": x}), prediction, time_of(whole, {whole.get_inputs()[0].name: window}))
                if round_:  # the first one warms up
                    samples.append(found)
            rows.append((structure, batch, *(statistics.median(column) for column in zip(*samples))))
            print(rows[-1], flush=True)
    return rows


# --- over HTTP -----------------------------------------------------------------------------------

MLSERVER_RUNTIME = '''
import numpy, onnxruntime
from mlserver import MLModel
from mlserver.codecs import NumpyCodec
from mlserver.types import InferenceResponse

class Onnx(MLModel):
    async def load(self):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(self.settings.parameters.uri, options)
        return True

    async def predict(self, payload):
        window = NumpyCodec.decode_input(payload.inputs[0]).astype(numpy.float64, copy=False)
        estimates = self.session.run(None, {self.session.get_inputs()[0].name: window})[0]
        output = NumpyCodec.encode_output("estimates", estimates)
        return InferenceResponse(model_name=self.name, outputs=[output])
'''

FASTAPI_APP = '''
import os
import numpy, onnxruntime
from fastapi import FastAPI
from pydantic import BaseModel

class Tensor(BaseModel):
    name: str
    datatype: str
    shape: list[int]
    data: list[float]

class Request(BaseModel):
    inputs: list[Tensor]

options = onnxruntime.SessionOptions()
options.intra_op_num_threads = options.inter_op_num_threads = 1
session = onnxruntime.InferenceSession(os.environ["MODEL"], options)
app = FastAPI()

@app.post("/v2/models/m/infer")
async def infer(request: Request):
    tensor = request.inputs[0]
    window = numpy.array(tensor.data, dtype=numpy.float64).reshape(tensor.shape)
    estimates = session.run(None, {session.get_inputs()[0].name: window})[0]
    return {"model_name": "m", "outputs": [{"name": "estimates", "datatype": "FP64",
            "shape": list(estimates.shape), "data": estimates.ravel().tolist()}]}
'''


def free_port():
    import socket

    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def wait_for(address, path, process):
    for _ in range(600):
        try:
            connection = http.client.HTTPConnection(address, timeout=5)
            connection.request("GET", path)
            if connection.getresponse().status < 500:
                return
        except OSError:
            pass
        assert process.poll() is None, "a server ended before it answered"
        time.sleep(0.1)
    raise AssertionError("a server does not answer")


class Server:
    def __init__(self, name, process, address, model, environment=None):
        self.name, self.process, self.address, self.model = name, process, address, model

    def stat(self):
        """CPU seconds of the process and its children, resident and peak memory in MB."""
        ticks, resident, peak = 0, 0, 0
        for pid in family(self.process.pid):
            fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
            ticks += int(fields[11]) + int(fields[12])
            status = dict(line.split(":", 1) for line in pathlib.Path(f"/proc/{pid}/status").read_text().splitlines())
            resident += int(status["VmRSS"].split()[0]) / 1024
            peak += int(status["VmHWM"].split()[0]) / 1024
        return ticks / os.sysconf("SC_CLK_TCK"), resident, peak

    def close(self):
        for pid in reversed(family(self.process.pid)):
            try:
                os.kill(pid, 9)
            except ProcessLookupError:
                pass
        self.process.wait()


def family(pid):
    children = pathlib.Path(f"/proc/{pid}/task/{pid}/children")
    found = [pid]
    if children.exists():
        for child in children.read_text().split():
            found += family(int(child))
    return found


def start_ours(bench, structure="RLR"):
    process = subprocess.Popen([bench.binary, "serve", bench.folder / structure], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    said = json.loads(process.stdout.readline())
    return Server("hydroflex", process, said["address"], said["model"])


def start_mlserver(bench):
    folder = bench.folder / "mlserver"
    folder.mkdir()
    port = free_port()
    (folder / "runtime.py").write_text(MLSERVER_RUNTIME)
    (folder / "settings.json").write_text(json.dumps({
        "http_port": port, "grpc_port": free_port(), "metrics_port": free_port(), "host": "127.0.0.1",
        "parallel_workers": 0, "debug": False, "logging_settings": None, "use_structured_logging": False,
    }))
    (folder / "model-settings.json").write_text(json.dumps({
        "name": "m", "implementation": "runtime.Onnx", "parameters": {"uri": str(bench.folder / "RLR" / "model.onnx")},
    }))
    log = open(folder / "log", "w")
    mlserver = pathlib.Path(sys.executable).parent / "mlserver"
    process = subprocess.Popen([mlserver, "start", folder], stdout=log, stderr=log, cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)})
    server = Server("MLServer 1.7.1, parallel_workers=0", process, f"127.0.0.1:{port}", "m")
    wait_for(server.address, "/v2/models/m/ready", process)
    return server


def start_fastapi(bench):
    folder = bench.folder / "fastapi"
    folder.mkdir()
    (folder / "app.py").write_text(FASTAPI_APP)
    port = free_port()
    log = open(folder / "log", "w")
    process = subprocess.Popen(
        [sys.executable, "-m", "uvicorn", "app:app", "--port", str(port), "--log-level", "warning", "--no-access-log"],
        stdout=log, stderr=log, cwd=folder, env={**os.environ, "MODEL": str(bench.folder / "RLR" / "model.onnx")},
    )
    server = Server("FastAPI + onnxruntime", process, f"127.0.0.1:{port}", "m")
    wait_for(server.address, "/docs", process)
    return server


def request_file(bench, server, windows, binary):
    rng = numpy.random.default_rng(1)
    typical = [(0.0, 0.3), (1.05, 0.02), (0.0, 0.02), (5e6, 5e5), (4e6, 5e5)]
    data = numpy.stack([m + s * rng.standard_normal((windows, STEPS)) for m, s in typical], axis=-1).astype(numpy.float32)
    tensor = {"name": "window", "datatype": "FP32", "shape": [windows, STEPS, INPUTS]}
    request = {"inputs": [tensor], "outputs": [{"name": "estimates"}]}
    heads, tail = "", b""
    if binary:
        tail = data.tobytes()
        tensor["parameters"] = {"binary_data_size": len(tail)}
        request["outputs"][0]["parameters"] = {"binary_data": True}
    else:
        # As many digits as single precision has: nobody is slowed down by more.
        tensor["data"] = [float(f"{value:.9g}") for value in data.ravel()]
    text = json.dumps(request).encode()
    if binary:
        heads = f"Inference-Header-Content-Length: {len(text)}\r\n"
    body = text + tail
    head = (f"POST /v2/models/{server.model}/infer HTTP/1.1\r\nHost: {server.address}\r\n"
            f"Content-Type: application/{'octet-stream' if binary else 'json'}\r\n{heads}Content-Length: {len(body)}\r\n\r\n")
    path = bench.folder / f"request-{server.model}-{windows}-{binary}"
    path.write_bytes(head.encode() + body)
    return path


def load(bench, server, request, connections, seconds, rate=0):
    before = server.stat()[0]
    out = subprocess.run(
        [bench.binary, "load", server.address, str(connections), str(seconds), str(rate), request],
        check=True, capture_output=True, text=True,
    ).stdout
    found = json.loads(out)
    requests = sum(found["statuses"].values())
    found["cpu_us"] = (server.stat()[0] - before) / max(requests, 1) * 1e6
    return found


def over_http(bench, ours, rounds, seconds):
    servers = [ours, start_mlserver(bench), start_fastapi(bench)]
    try:
        table = []
        for windows, binary_ours in [(1, False), (64, True), (64, False)]:
            samples = {server.name: [] for server in servers}
            for _ in range(rounds):
                for server in servers:
                    # MLServer answers 500 to these binary tensors, FastAPI has none: they are compared by JSON.
                    if binary_ours and server is not ours:
                        continue
                    found = load(bench, server, request_file(bench, server, windows, binary_ours), 16, seconds)
                    assert set(found["statuses"]) == {"200"}, (server.name, found)
                    samples[server.name].append(found)
            for server in servers:
                if samples[server.name]:
                    median = {key: statistics.median(s[key] for s in samples[server.name])
                              for key in ("per_second", "cpu_us", "p50_us", "p99_us")}
                    table.append((server.name, windows, "bytes" if binary_ours else "JSON", median))
                    print(table[-1], flush=True)
        return table
    finally:
        for server in servers[1:]:
            server.close()


def ours_only(bench, ours, seconds):
    """p99 at half load, what overload does, memory after many requests, live sessions."""
    found = {}
    one = request_file(bench, ours, 1, False)
    most = load(bench, ours, one, 16, seconds)["per_second"]
    found["half"] = load(bench, ours, one, 16, 2 * seconds, most / 2) | {"rate": most / 2}
    large = request_file(bench, ours, 4096, True)
    found["large"] = load(bench, ours, large, 2, seconds)
    found["overload"] = load(bench, ours, large, 64, seconds)
    before = ours.stat()[1]
    answered, begun = 0, time.monotonic()
    while answered < 1_000_000 and time.monotonic() < begun + 90:
        answered += load(bench, ours, one, 16, 10)["answers"]
    found["million"] = {"answers": answered, "before_mb": before, "after_mb": ours.stat()[1]}

    def sessions(count, rate, length):
        cpu = ours.stat()[0]
        before = ours.stat()[1]
        process = subprocess.Popen([bench.binary, "stream", ours.address, ours.model, str(count), str(rate), str(length)],
                                   stdout=subprocess.PIPE, text=True)
        time.sleep(0.3 * length)
        early = ours.stat()[1]
        time.sleep(0.5 * length)
        late = ours.stat()[1]
        out = json.loads(process.communicate()[0])
        out |= {"before_mb": before, "early_mb": early, "late_mb": late}
        out["cpu_us"] = (ours.stat()[0] - cpu) / out["answers"] * 1e6
        return out

    found["one"] = sessions(1, 1000, seconds)
    found["fifty"] = sessions(50, 1000, 2 * seconds)
    found["thousand"] = sessions(1000, 10, 4 * seconds)
    return found


def long_recording(bench, rows):
    """A Parquet file of many rows through /predict; peak memory of a fresh service."""
    import pyarrow
    import pyarrow.parquet

    path = bench.folder / "long.parquet"
    names = ["valve_lift_ratio", "length_lift_m", "velocity_lift_m_per_s", "pressure_lift_piston_pa", "pressure_lift_rod_pa"]
    writer, done = None, 0
    while done < rows:
        count = min(500_000, rows - done)
        t = numpy.arange(done, done + count) * 0.005
        table = pyarrow.table({name: (mean + size * numpy.sin((1.3 + i) * t)).astype(numpy.float32)
                               for i, (name, mean, size) in enumerate(zip(names, [0, 1.05, 0, 5e6, 4e6], [.5, .1, .05, 2e6, 2e6]))})
        writer = writer or pyarrow.parquet.ParquetWriter(path, table.schema)
        writer.write_table(table)
        done += count
    writer.close()
    server = start_ours(bench)
    try:
        results = []
        for limit in (rows // 10, rows):
            if limit < rows:
                part = bench.folder / "part.parquet"
                pyarrow.parquet.write_table(pyarrow.parquet.ParquetFile(path).read_row_group(0).slice(0, limit), part)
                with pyarrow.parquet.ParquetWriter(part, pyarrow.parquet.read_schema(path)) as writer:
                    file = pyarrow.parquet.ParquetFile(path)
                    for group in range(limit // 500_000):
                        writer.write_table(file.read_row_group(group))
            source = path if limit == rows else part
            begun = time.monotonic()
            connection = http.client.HTTPConnection(server.address, timeout=600)
            with open(source, "rb") as body:
                connection.request("POST", f"/v1/models/{server.model}/predict", body, {
                    "content-type": "application/vnd.apache.parquet", "content-length": str(source.stat().st_size)})
                answer = connection.getresponse()
                assert answer.status == 200, answer.read()
                size, out = 0, bench.folder / "answer.parquet"
                with open(out, "wb") as sink:
                    while piece := answer.read(1 << 20):
                        size += sink.write(piece)
            metadata = pyarrow.parquet.read_metadata(out)
            cpu, _, peak = server.stat()
            results.append({"rows": metadata.num_rows, "seconds": time.monotonic() - begun, "peak_mb": peak, "cpu_s": cpu,
                            "sent_mb": source.stat().st_size / 1e6, "received_mb": size / 1e6})
            print(results[-1], flush=True)
        return results
    finally:
        server.close()


def report(kernel, http_table, ours, recording, arguments):
    def us(value):
        return f"{value:.2f}" if value < 10 else f"{value:.0f}"

    lines = [
        "# Speed of predictions", "",
        "Made by `tests/bench/serving.py` (its head says how). Windows of 60 steps of 5 sensors, one target, random weights; "
        f"medians of {arguments.rounds} rounds in which everything compared runs in turn.", "",
        f"Machine: {machine()}. It did other work at the same time, so ratios count.", "",
    ]
    if kernel:
        lines += [
            "## In process, one thread, µs of CPU per call", "",
            "*Network*: f32 in, f32 out, onnxruntime with a plain graph. *Prediction*: samples in engineering units in, estimates out, "
            "onnxruntime with our `model.onnx`, which holds the scales.", "",
            "| structure | batch | network: ours | onnxruntime | ratio | prediction: ours | onnxruntime | ratio |",
            "|---|---|---|---|---|---|---|---|",
        ]
        lines += [f"| {s} | {b} | {us(a)} | {us(o)} | {o / a:.2f} | {us(p)} | {us(w)} | {w / p:.2f} |"
                  for s, b, a, o, p, w in kernel]
    if http_table:
        lines += [
            "", "## Over HTTP, Open Inference Protocol, RLR", "",
            "16 connections on loopback, each with one request at a time; the client shares the machine's cores with the server. "
            "CPU time is the server's. `bytes`: binary tensors both ways, relative to MLServer's JSON.", "",
            "| server | windows | body | requests/s | CPU µs/request | requests per CPU second, relative | p50 µs | p99 µs |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for name, windows, body, median in http_table:
            reference = next(m for n, w, _, m in http_table if "MLServer" in n and w == windows)
            lines.append(f"| {name} | {windows} | {body} | {median['per_second']:.0f} | {median['cpu_us']:.1f} | "
                         f"{reference['cpu_us'] / median['cpu_us']:.1f} | {us(median['p50_us'])} | {us(median['p99_us'])} |")
    if ours:
        half, over, large = ours["half"], ours["overload"], ours["large"]
        accepted = over["statuses"].get("200", 0)
        refused = over["statuses"].get("429", 0)
        lines += [
            "", "## Our service alone", "",
            f"- Half of the saturating load ({half['rate']:.0f} requests/s, one window as JSON): p50 {us(half['p50_us'])} µs, p99 {us(half['p99_us'])} µs.",
            f"- Overload, 4,096 windows per request: 2 connections get {large['per_second']:.0f} answers/s with p99 {large['p99_us'] / 1000:.1f} ms; "
            f"64 connections get {over['per_second']:.0f} answers/s with p99 {over['p99_us'] / 1000:.1f} ms ({accepted} answered, {refused} refused with 429).",
            f"- Memory: {ours['million']['before_mb']:.1f} MB before and {ours['million']['after_mb']:.1f} MB after {ours['million']['answers']:,} more requests.",
        ]
        for key, text in [("one", "1 session at 1 kHz"), ("fifty", "50 sessions at 1 kHz"), ("thousand", "1,000 sessions at 10 Hz")]:
            s = ours[key]
            lines.append(f"- {text}: {s['per_second']:.0f} estimates/s, round trip p50 {us(s['p50_us'])} µs, p99 {us(s['p99_us'])} µs, "
                         f"{s['cpu_us']:.1f} µs of CPU per sample, memory {s['early_mb']:.1f} MB early and {s['late_mb']:.1f} MB late in the run.")
    if recording:
        lines += ["", "## A long recording as Parquet", "", "| rows | seconds | sent MB | received MB | peak memory of the service, MB |", "|---|---|---|---|---|"]
        lines += [f"| {r['rows']:,} | {r['seconds']:.1f} | {r['sent_mb']:.0f} | {r['received_mb']:.0f} | {r['peak_mb']:.0f} |" for r in recording]
    return "\n".join(lines) + "\n"


def machine():
    model = next(line.split(":", 1)[1].strip() for line in open("/proc/cpuinfo") if line.startswith("model name"))
    return f"{os.cpu_count()} × {model}"


def main():
    parser = argparse.ArgumentParser(description=textwrap.dedent(__doc__), formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", default="target/release/examples/serving_bench")
    parser.add_argument("--out", help="file for the report; standard output if absent")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=3, help="of each load")
    parser.add_argument("--rows", type=int, default=10_000_000, help="of the long recording")
    parser.add_argument("--only", choices=["kernel", "http", "ours", "recording"], action="append")
    parser.add_argument("--results", help="file of measured numbers; parts that are not measured now are taken from it")
    arguments = parser.parse_args()
    parts = arguments.only or ["kernel", "http", "ours", "recording"]
    results = {}
    if arguments.results and os.path.exists(arguments.results):
        results = json.loads(pathlib.Path(arguments.results).read_text())
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(os.path.abspath(arguments.binary), folder)
        if "kernel" in parts:
            results["kernel"] = in_process(bench, arguments.rounds)
        ours = start_ours(bench)
        try:
            if "http" in parts:
                results["http"] = over_http(bench, ours, min(arguments.rounds, 3), arguments.seconds)
            if "ours" in parts:
                results["ours"] = ours_only(bench, ours, arguments.seconds)
        finally:
            ours.close()
        if "recording" in parts:
            results["recording"] = long_recording(bench, arguments.rows)
        bench.close()
    if arguments.results:
        pathlib.Path(arguments.results).write_text(json.dumps(results))
    text = report(results.get("kernel"), results.get("http"), results.get("ours"), results.get("recording"), arguments)
    if arguments.out:
        pathlib.Path(arguments.out).write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    main()
