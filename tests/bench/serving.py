"""Speed of predictions: our kernel beside onnxruntime in process, our service beside MLServer and
FastAPI + onnxruntime over HTTP, live sessions, overload, long recordings, restarts.

    cargo build --release --workspace --example serving_bench --bin hydroflex
    python3 -m venv target/bench-venv
    target/bench-venv/bin/pip install 'mlserver==1.7.1' 'uvloop<0.22' onnxruntime onnx fastapi uvicorn numpy pyarrow
    target/bench-venv/bin/python tests/bench/serving.py --results target/serving.json --out docs/benchmark-serving.md

`--only PART` measures one part again and takes the others from `--results`. Everything that is compared
runs in turn, round after round, so that what else the machine does meets everybody. Models have random
weights: how long a network takes does not depend on them.
"""

import argparse
import contextlib
import http.client
import json
import os
import pathlib
import re
import signal
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


def plain_onnx(folder, bounded=False):
    """The network alone, f32 in and out, as an exporter would write it: onnxruntime's best case. `bounded`: and what our
    kernel does besides, the estimate held near the guide and in its range."""
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
    if bounded:
        guard, targets = config["guard"], config["targets"]

        def constant(name, values):
            constants.append(numpy_helper.from_array(numpy.array(values, numpy.float32), name))
            return name

        def scaled(ends):
            return [(end - target["offset"]) / target["scale"] for end, target in zip(ends, targets)]

        gemm("guard", "x", "guide")
        constant("slack", [slack / target["scale"] for slack, target in zip(guard["slack"], targets)])
        for place, (operator, inputs) in enumerate([
            ("Sub", ["guide", "slack"]), ("Add", ["guide", "slack"]), ("Max", [x, "bound0"]), ("Min", ["bound2", "bound1"]),
            ("Max", ["bound3", constant("lowest", scaled(guard["min"]))]), ("Min", ["bound4", constant("highest", scaled(guard["max"]))]),
        ]):
            nodes.append(helper.make_node(operator, inputs, [f"bound{place}"]))
        x = "bound5"
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
    """µs of CPU per call: our network, onnxruntime's, our whole prediction, model.onnx with its scales, onnxruntime's
    network with our bounds, torch's."""
    import onnxruntime

    torch = import_torch()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    # A thread that waits by spinning would slow everything beside it.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    rows = []
    for structure in STRUCTURES:
        folder = bench.folder / structure
        plain = onnxruntime.InferenceSession(plain_onnx(folder), options, providers=["CPUExecutionProvider"])
        bounded = onnxruntime.InferenceSession(plain_onnx(folder, bounded=True), options, providers=["CPUExecutionProvider"])
        whole = onnxruntime.InferenceSession((folder / "model.onnx").read_bytes(), options, providers=["CPUExecutionProvider"])
        compiled = torch and torch_network(torch, folder)
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
                found = [network, time_of(plain, {"x": x}), prediction, time_of(whole, {whole.get_inputs()[0].name: window}),
                         time_of(bounded, {"x": x})]
                if torch:
                    tensor = torch.from_numpy(x)
                    begun = time.thread_time()
                    for _ in range(calls):
                        compiled(tensor)
                    found.append((time.thread_time() - begun) / calls * 1e6)
                if round_:  # the first one warms up
                    samples.append(found)
            rows.append((structure, batch, *(statistics.median(column) for column in zip(*samples))))
            print(rows[-1], flush=True)
    return rows


def import_torch():
    try:
        import torch
    except ImportError:
        return None
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    return torch


def torch_network(torch, folder):
    """The network as a frozen TorchScript module."""
    config, tensors = json.loads((folder / "config.json").read_text()), safetensors(folder / "model.safetensors")
    kinds = {"tanh": torch.nn.Tanh, "sigmoid": torch.nn.Sigmoid, "relu": torch.nn.ReLU, "elu": torch.nn.ELU, "silu": torch.nn.SiLU}

    def linear(prefix):
        weight, bias = (torch.from_numpy(tensors[f"{prefix}.{part}"].copy()) for part in ("weight", "bias"))
        module = torch.nn.Linear(weight.shape[1], weight.shape[0])
        module.weight.data, module.bias.data = weight, bias
        return module

    class Network(torch.nn.Module):
        def __init__(self):
            super().__init__()
            parts = [part for layer in config["layers"]
                     for part in [linear(layer["name"]), *(kinds[a]() for a in layer["activations"])]]
            self.body = torch.nn.Sequential(*parts)
            self.skip = linear("skip") if config["linear_skip"] else None

        def forward(self, x):
            y = self.body(x)
            return y if self.skip is None else y + self.skip(x)

    module = Network().eval()
    return torch.jit.freeze(torch.jit.script(module))


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


# The kernel takes a core from real-time programs that hold it for 0.95 s of a second: bursts, and a pause after each.
BURST_S, PAUSE_S = 0.7, 1.3


def promote(process=0):
    """Before other programs on this machine, whose turns of milliseconds would be taken for latencies; where it is
    not allowed, beside them."""
    with contextlib.suppress(PermissionError):
        for thread in os.listdir(f"/proc/{process}/task") if process else [0]:
            os.sched_setscheduler(int(thread), os.SCHED_RR, os.sched_param(1))


def load(bench, server, request, connections, seconds, rate=None, first=False):
    """Every connection as fast as it is answered, or all together `rate` requests per second on a schedule; `first`: before
    other programs."""
    before = server.stat()[0]
    command = ["load", server.address, connections, seconds, request] if rate is None else \
        ["open-loop", server.address, connections, seconds, rate, request]
    out = subprocess.run([bench.binary, *map(str, command)], check=True, capture_output=True, text=True,
                         preexec_fn=promote if first else None).stdout
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
                    # Where others take the cores for a moment, our gate refuses some of what would wait too long.
                    refused = found["statuses"].pop("429", 0)
                    assert set(found["statuses"]) == {"200"} and refused <= 0.02 * found["answers"], (server.name, refused, found)
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


def medians(runs, keys=("p50_us", "p99_us")):
    found = {key: statistics.median(run[key] for run in runs) for key in keys}
    return found | {"best_p99_us": min(run["p99_us"] for run in runs)}


def start_echo(bench, request):
    process = subprocess.Popen([bench.binary, "echo", request], stdout=subprocess.PIPE, text=True)
    return Server("echo", process, json.loads(process.stdout.readline())["address"], "echo")


def burst(bench, server, request, rate=None):
    found = load(bench, server, request, 16, BURST_S, rate, first=True)
    time.sleep(PAUSE_S)
    return found


def latency(bench, rounds):
    """p50 and p99 at half of the saturating load, one window as JSON and as bytes, beside a server that answers at once."""
    found = {}
    for name, binary in (("JSON", False), ("bytes", True)):
        with apart() as client:
            ours = start_ours(bench)
            one = request_file(bench, ours, 1, binary)
            echo = start_echo(bench, one)
            client()
            for server in (ours, echo):
                promote(server.process.pid)
            try:
                most = statistics.median(burst(bench, ours, one)["per_second"] for _ in range(5))
                runs = {server.name: [] for server in (ours, echo)}
                for _ in range(2 * rounds):
                    for server in (ours, echo):
                        runs[server.name].append(burst(bench, server, one, most / 2))
            finally:
                ours.close()
                echo.close()
        found[name] = {"rate": most / 2} | {server: medians(of, ("p50_us", "p99_us", "late_p99_us")) for server, of in runs.items()}
        print(name, found[name], flush=True)
    return found


@contextlib.contextmanager
def apart():
    """Services that are started now on one half of the cores; what is started after a call of what this
    yields, on the other: a latency is then not the wait for a core that the client's own threads hold."""
    cores = sorted(os.sched_getaffinity(0))
    half = max(len(cores) // 2, 1)
    os.sched_setaffinity(0, cores[:half])
    try:
        yield lambda: os.sched_setaffinity(0, cores[half:] or cores)
    finally:
        os.sched_setaffinity(0, cores)


def overload(bench, ours, seconds):
    """More than can be done: what is refused, and what becomes of the latency of what is accepted."""
    table = []
    for windows, binary, few, many in [(1, False, 16, 4000), (64, False, 4, 256), (4096, True, 2, 64)]:
        request = request_file(bench, ours, windows, binary)
        for connections in (few, many):
            found = load(bench, ours, request, connections, seconds)
            table.append({"windows": windows, "body": "bytes" if binary else "JSON", "connections": connections,
                          "answered": found["statuses"].get("200", 0), "refused": found["statuses"].get("429", 0),
                          **{key: found[key] for key in ("per_second", "p50_us", "p99_us")}})
            assert set(found["statuses"]) <= {"200", "429"}, found
            print(table[-1], flush=True)
    return table


def memory(bench, ours, count):
    one = request_file(bench, ours, 1, False)
    load(bench, ours, one, 16, 2)
    before, answered, begun = ours.stat()[1], 0, time.monotonic()
    while answered < count:
        answered += load(bench, ours, one, 16, 5)["answers"]
        print(f"{answered} answers, {ours.stat()[1]:.1f} MB", flush=True)
    return {"answers": answered, "before_mb": before, "after_mb": ours.stat()[1], "seconds": time.monotonic() - begun}


def streams(bench, rounds, seconds):
    with apart() as client:
        ours = start_ours(bench)
        client()
        promote(ours.process.pid)
        try:
            return [sessions_of(bench, ours, *rest)
                    for rest in [(2 * rounds, 1, 1000, BURST_S), (2 * rounds, 50, 1000, BURST_S), (rounds, 1000, 10, 4 * seconds)]]
        finally:
            ours.close()


def sessions_of(bench, ours, rounds, count, rate, length):
    runs, early = [], None
    cpu, before, _ = ours.stat()
    for _ in range(rounds):
        first = length <= BURST_S
        process = subprocess.Popen([bench.binary, "stream", ours.address, ours.model, str(count), str(rate), str(length)],
                                   stdout=subprocess.PIPE, text=True, preexec_fn=promote if first else None)
        # Sessions are opened before the first sample.
        time.sleep(0.5 + count * 1e-3 + 0.2 * length)
        early = early or ours.stat()[1]
        time.sleep(0.6 * length)
        late = ours.stat()[1]
        runs.append(json.loads(process.communicate()[0]))
        if first:
            time.sleep(PAUSE_S)
    out = medians(runs) | {"sessions": count, "rate": rate, "before_mb": before, "early_mb": early, "late_mb": late}
    out["cpu_us"] = (ours.stat()[0] - cpu) / sum(run["answers"] for run in runs) * 1e6
    print(out, flush=True)
    return out


def felt(bench, rounds):
    """A manoeuvre of 1 s (200 samples, an estimate for each): simulated, and estimated."""
    text = (pathlib.Path(__file__).parents[2] / "docs" / "benchmark-simulator.md").read_text()

    def simulated(row):
        found = re.search(rf"^\| {re.escape(row)} \|(.*)\|$", text, re.MULTILINE)
        return statistics.median(float(cell) * 1e3 for cell in found[1].split("|"))

    rows = {
        "Exudyn, as published scripts drive it": simulated("Exudyn, as published scripts drive it (whole run)"),
        "Exudyn at its best, same step": simulated("Exudyn at its best, 5 ms (whole run)"),
        "hydroflex `accurate`, alone": simulated("hydroflex `accurate` (tolerance 1e-3), alone"),
        "hydroflex `accurate`, in a batch": simulated("hydroflex `accurate` (tolerance 1e-3), in a batch, per run and core"),
    }
    networks, batches = {}, {}
    for structure in STRUCTURES:
        samples = []
        for _ in range(rounds):
            out = subprocess.run([bench.binary, "series", bench.folder / structure, str(200 + STEPS - 1), "200"],
                                 check=True, capture_output=True, text=True).stdout
            samples.append(json.loads(out)["us"])
        networks[structure] = statistics.median(samples)
        batches[structure] = statistics.median(bench.kernel(structure, 4096, 20)[1] / 4096 for _ in range(rounds))
    print(rows, networks, batches, flush=True)
    return {"simulated": rows, "networks": networks, "batches": batches}


def restart(bench, hydroflex, rounds):
    """kill -9 in the middle of requests, and again until the same estimates come."""
    data = bench.folder / "data"
    out = subprocess.run([bench.binary, "register", bench.folder / "RLR", data], check=True, capture_output=True, text=True).stdout
    model, port = json.loads(out)["model"], free_port()
    server = Server("", None, f"127.0.0.1:{port}", model)
    request = request_file(bench, server, 1, False)
    body = request.read_bytes().split(b"\r\n\r\n", 1)[1]

    def estimate():
        connection = http.client.HTTPConnection(server.address, timeout=1)
        connection.request("POST", f"/v2/models/{model}/infer", body, {"content-type": "application/json"})
        answer = connection.getresponse()
        assert answer.status == 200, answer.read()
        return answer.read()

    times, first = [], None
    for _ in range(rounds + 1):
        begun = time.monotonic()
        process = subprocess.Popen([hydroflex, "serve", "--data", data, "--workers", "0", "--listen", server.address],
                                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while True:
            assert process.poll() is None, "the service ended"
            try:
                answer = estimate()
                break
            except OSError:
                time.sleep(0.005)
        times.append(time.monotonic() - begun)
        first = first or answer
        assert answer == first, "another estimate after the restart"
        traffic = subprocess.Popen([bench.binary, "load", server.address, "4", "5", request], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(0.3)
        process.send_signal(signal.SIGKILL)
        process.wait()
        traffic.wait()
    found = {"first_s": times[0], "median_s": statistics.median(times[1:]), "worst_s": max(times[1:]), "kills": rounds + 1}
    print(found, flush=True)
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
    results = []
    for limit in (rows // 10, rows):
        server = start_ours(bench)
        try:
            if limit < rows:
                part, left = bench.folder / "part.parquet", limit
                with pyarrow.parquet.ParquetWriter(part, pyarrow.parquet.read_schema(path)) as writer:
                    for batch in pyarrow.parquet.ParquetFile(path).iter_batches(500_000):
                        writer.write_batch(batch.slice(0, left))
                        left -= min(left, batch.num_rows)
                        if left == 0:
                            break
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
        finally:
            server.close()
    return results


def report(results, arguments):
    def us(value):
        return f"{value:.2f}" if value < 10 else f"{value:,.0f}"

    lines = [
        "# Speed of predictions", "",
        "Made by `tests/bench/serving.py` (its head says how; `--only PART` for one part). Windows of 60 steps of 5 sensors, one target, "
        f"random weights; medians of up to {arguments.rounds} rounds in which everything compared runs in turn.", "",
        f"Machine: {machine()}. Other programs ran on it meanwhile (load average {results.get('load', 'unknown')} "
        "at the end of each part): compare ratios.",
    ]
    if kernel := results.get("kernel"):
        torch = any(len(row) > 7 for row in kernel)
        lines += [
            "", "## In process, one thread, µs of CPU per call (`--only kernel`)", "",
            "*Network*: f32 in, f32 out. Ours holds every estimate near its guide and in its range (`ml/src/predict/guard.rs`), a second linear map of the window; "
            "onnxruntime runs the plain graph, as anybody would export it, and then one that has these bounds too, which compares like with like. "
            "*Prediction*: samples in engineering units in, estimates out, "
            "onnxruntime with our `model.onnx`, which holds the scales. `best` has a skip connection with constant coefficients here; coefficients that "
            "follow the pose are not measured."
            + ("" if torch else " torch is not installed here, so there is no column for it; the script fills one where it is."), "",
            "| structure | batch | network: ours | onnxruntime, plain | ratio | with our bounds | ratio |" + (" torch, plain | ratio |" if torch else "")
            + " prediction: ours | onnxruntime | ratio |",
            "|---|---|---|---|---|---|---|---|---|---|" + ("---|---|" if torch else ""),
        ]
        for s, b, a, o, p, w, g, *t in kernel:
            line = f"| {s} | {b} | {us(a)} | {us(o)} | {o / a:.2f} | {us(g)} | {g / a:.2f} |"
            line += "".join(f" {us(v)} | {v / a:.2f} |" for v in t)
            lines.append(line + f" {us(p)} | {us(w)} | {w / p:.2f} |")
    if http_table := results.get("http"):
        lines += [
            "", "## Over HTTP, Open Inference Protocol, RLR (`--only http`)", "",
            "16 connections on loopback, each with one request at a time; the client shares the machine's cores with the server. "
            "CPU time is the server's. `bytes`: binary tensors both ways, relative to MLServer's JSON.", "",
            "| server | windows | body | requests/s | CPU µs/request | requests per CPU second, relative | p50 µs | p99 µs |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for name, windows, body, median in http_table:
            reference = next(m for n, w, _, m in http_table if "MLServer" in n and w == windows)
            lines.append(f"| {name} | {windows} | {body} | {median['per_second']:.0f} | {median['cpu_us']:.1f} | "
                         f"{reference['cpu_us'] / median['cpu_us']:.1f} | {us(median['p50_us'])} | {us(median['p99_us'])} |")
    if half := results.get("latency"):
        lines += ["", "## At half of the saturating load (`--only latency`)", "",
                  "The service on one half of the cores; on the other one client thread that never sleeps, with 16 connections; both before other programs "
                  f"(real-time priority, in bursts of {BURST_S} s). A latency counts from when its request was due. *Client late*: how long the client itself let a "
                  "request wait that was due on a free connection; it is in the latencies. *Echo* reads as many bytes, looks at nothing and answers at once, in turn with the service: what the machine takes by "
                  "itself.", "",
                  "| one window as | requests/s | p50 µs | p99 µs | best round's p99 µs | client late: p99 µs | echo: p50 µs | p99 µs | best round's p99 µs | client late: p99 µs |",
                  "|---|---|---|---|---|---|---|---|---|---|"]
        lines += [f"| {name} | {f['rate']:.0f} | " + " | ".join(us(f[server][key]) for server in ("hydroflex", "echo")
                                                               for key in ("p50_us", "p99_us", "best_p99_us", "late_p99_us")) + " |"
                  for name, f in half.items()]
    if over := results.get("overload"):
        lines += ["", "## Overload (`--only overload`)", "",
                  "The gate refuses what would wait more than 25 ms behind what was read before it. Bodies above 256 KiB are asked about before they are received: "
                  "two per core are received or computed at once, the others wait up to 25 ms for a place. The rest of a refused body is read away slowly, so that "
                  "clients that read only after they have sent everything, as these do, see the 429; they then connect anew. Each connection asks again as soon as it "
                  "is answered, 20 ms after a refusal. Latencies of what was answered, as the client sees them: with thousands of connections its own queue is in them.", "",
                  "| windows | body | connections | answers/s | answered | refused with 429 | p50 ms | p99 ms |", "|---|---|---|---|---|---|---|---|"]
        lines += [f"| {o['windows']} | {o['body']} | {o['connections']} | {o['per_second']:.0f} | {o['answered']:,} | {o['refused']:,} | "
                  f"{o['p50_us'] / 1e3:.1f} | {o['p99_us'] / 1e3:.1f} |" for o in over]
    if found := results.get("streams"):
        lines += ["", "## Live sessions (`--only streams`)", "",
                  "The service on one half of the cores; on the other one client thread that never sleeps and sends every sample when it is due. The service, and the "
                  f"client of sessions at 1 kHz, come before other programs (real-time priority, those in bursts of {BURST_S} s). A round trip counts from when its "
                  "sample was sent.", "",
                  "| sessions | samples/s each | round trip p50 µs | p99 µs | best round's p99 µs | CPU µs of the service per sample | memory early, MB | late |",
                  "|---|---|---|---|---|---|---|---|"]
        lines += [f"| {s['sessions']:,} | {s['rate']} | {us(s['p50_us'])} | {us(s['p99_us'])} | {us(s['best_p99_us'])} | "
                  f"{s['cpu_us']:.1f} | {s['early_mb']:.1f} | {s['late_mb']:.1f} |" for s in found]
    if recording := results.get("recording"):
        lines += ["", "## A long recording as Parquet (`--only recording`)", "", "A fresh service for each.", "",
                  "| rows | seconds | CPU s of the service | sent MB | received MB | peak memory of the service, MB |", "|---|---|---|---|---|---|"]
        lines += [f"| {r['rows']:,} | {r['seconds']:.1f} | {r['cpu_s']:.1f} | {r['sent_mb']:.0f} | {r['received_mb']:.0f} | {r['peak_mb']:.0f} |" for r in recording]
    if speed := results.get("felt"):
        lines += ["", "## A manoeuvre of one second (`--only felt`)", "",
                  "*Simulated*: ms per run on one core, median over the payloads of [benchmark-simulator.md](benchmark-simulator.md). *Estimated*: the same "
                  "200 samples, an estimate for each, columns in and columns out; and, as the paper counts, one window of a batch of 4,096 for each run. "
                  "One core throughout; no GPU was at hand.", "",
                  "| | ms | " + " | ".join(f"times {s}, {us(speed['networks'][s])} µs" for s in ("RLR", "best")) + " | times one window of RLR in a batch, "
                  f"{us(speed['batches']['RLR'])} µs |", "|---|---|---|---|---|"]
        def times(ratio):
            return f"{ratio:,.0f}" if ratio >= 10 else f"{ratio:.1f}"

        lines += [f"| {name} | {value / 1e3:,.4g} | {times(value / speed['networks']['RLR'])} | {times(value / speed['networks']['best'])} | "
                  f"{value / speed['batches']['RLR']:.1e} |" for name, value in speed["simulated"].items()]
    if (mem := results.get("memory")) or results.get("restart"):
        lines += ["", "## Holding on", ""]
    if mem:
        lines.append(f"- {mem['answers']:,} requests (`--only memory`): {mem['before_mb']:.1f} MB before, {mem['after_mb']:.1f} MB after.")
    if again := results.get("restart"):
        lines.append(f"- kill -9 under load, {again['kills']} times (`--only restart`): from the start of the process to the first estimate, the same to the last "
                     f"digit, {again['median_s'] * 1e3:.0f} ms (median), {again['worst_s'] * 1e3:.0f} ms (worst).")
    return "\n".join(lines) + "\n"


def machine():
    model = next(line.split(":", 1)[1].strip() for line in open("/proc/cpuinfo") if line.startswith("model name"))
    return f"{os.cpu_count()} × {model}"


PARTS = ["kernel", "http", "latency", "overload", "streams", "memory", "recording", "felt", "restart"]


def main():
    parser = argparse.ArgumentParser(description=textwrap.dedent(__doc__), formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", default="target/release/examples/serving_bench")
    parser.add_argument("--hydroflex", default="target/release/hydroflex")
    parser.add_argument("--out", help="file for the report; standard output if absent")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3, help="of each load")
    parser.add_argument("--rows", type=int, default=10_000_000, help="of the long recording")
    parser.add_argument("--requests", type=int, default=1_000_000, help="of the memory part")
    parser.add_argument("--only", choices=[*PARTS, "nothing"], action="append", help="`nothing`: the report from --results")
    parser.add_argument("--results", help="file of measured numbers; parts that are not measured now are taken from it")
    arguments = parser.parse_args()
    results = {}
    if arguments.results and os.path.exists(arguments.results):
        results = json.loads(pathlib.Path(arguments.results).read_text())
    loads = results.setdefault("loads", {})
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(os.path.abspath(arguments.binary), folder)

        def with_ours(measure, *rest):
            ours = start_ours(bench)
            try:
                return measure(bench, ours, *rest)
            finally:
                ours.close()

        measures = {
            "kernel": lambda: in_process(bench, arguments.rounds),
            "http": lambda: with_ours(over_http, min(arguments.rounds, 3), arguments.seconds),
            "latency": lambda: latency(bench, arguments.rounds),
            "overload": lambda: with_ours(overload, arguments.seconds),
            "streams": lambda: streams(bench, arguments.rounds, arguments.seconds),
            "memory": lambda: with_ours(memory, arguments.requests),
            "recording": lambda: long_recording(bench, arguments.rows),
            "felt": lambda: felt(bench, arguments.rounds),
            "restart": lambda: restart(bench, os.path.abspath(arguments.hydroflex), arguments.rounds),
        }
        for part in arguments.only or PARTS:
            if part == "nothing":
                continue
            results[part] = measures[part]()
            loads[part] = round(os.getloadavg()[0], 1)
            if arguments.results:
                pathlib.Path(arguments.results).write_text(json.dumps(results))
        bench.close()
    results["load"] = ", ".join(f"{part} {load}" for part, load in loads.items())
    text = report(results, arguments)
    if arguments.out:
        pathlib.Path(arguments.out).write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    main()
