"""tritonclient[http], unchanged, against a running service: JSON, bytes, batches, gzip, metadata, errors."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request

import numpy
import tritonclient.http as triton

BINARY = os.environ.get("HYDROFLEX_BIN", "target/release/hydroflex")
# Small: what is served does not matter here, that it comes out of the chain does.
JOB = {
    "machine": "lift-boom",
    "runs": 10,
    "duration_s": 0.5,
    "settling_runs": 0,
    "seed": 1,
    "train": [{"structure": "L", "epochs": 2, "window": {"rule": "given", "window_s": 0.05}}],
}


class Service:
    """A service in a directory of its own; killed at the end."""

    def __init__(self, folder):
        self.folder = pathlib.Path(folder)
        self.start()

    def start(self):
        begun = time.monotonic()
        self.log = open(self.folder / "log", "ab")
        self.process = subprocess.Popen(
            [BINARY, "serve", "--listen", "127.0.0.1:0", "--data", self.folder / "data", "--workers", "2", "--json"],
            stdout=self.log, stderr=self.log,
        )
        while True:
            lines = self.folder.joinpath("log").read_text().splitlines()
            urls = [json.loads(line)["fields"].get("url") for line in lines if line.startswith("{") and '"url"' in line]
            if len(urls) > getattr(self, "starts", 0):
                self.starts = len(urls)
                self.url = urls[-1]
                return
            assert self.process.poll() is None, "the service ended: " + "\n".join(lines[-5:])
            assert time.monotonic() < begun + 60, "the service does not start"
            time.sleep(0.01)

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def ask(self, path, body=None, method=None, headers=None):
        request = urllib.request.Request(
            self.url + path,
            data=None if body is None else json.dumps(body).encode(),
            headers={"content-type": "application/json", **(headers or {})},
            method=method,
        )
        with urllib.request.urlopen(request) as answer:
            return json.load(answer)


def trained_model(service):
    job = service.ask("/v1/jobs", JOB)
    while job["state"] not in ("succeeded", "failed", "cancelled"):
        time.sleep(0.1)
        job = service.ask("/v1/jobs/" + job["job_id"])
    assert job["state"] == "succeeded", job
    return service.ask("/v1/models")["models"][0]["model_id"]


def window_input(windows, name="window", datatype="FP64", binary=True):
    tensor = triton.InferInput(name, list(windows.shape), datatype)
    kind = {"FP64": numpy.float64, "FP32": numpy.float32}[datatype]
    tensor.set_data_from_numpy(windows.astype(kind), binary_data=binary)
    return tensor


def check(service, model):
    client = triton.InferenceServerClient(service.url.removeprefix("http://"))
    assert client.is_server_live() and client.is_server_ready()
    assert client.is_model_ready(model)
    assert not client.is_model_ready("nobody@stable")
    assert client.get_server_metadata()["name"] == "hydroflex"
    metadata = client.get_model_metadata(model)
    _, steps, inputs = metadata["inputs"][0]["shape"]
    targets = metadata["parameters"]["targets"]
    assert [output["name"] for output in metadata["outputs"]][0] == "estimates"

    rng = numpy.random.default_rng(1)
    scales = {"valve": (0.0, 0.3), "length": (1.05, 0.02), "veloci": (0.0, 0.02), "pressu": (4e6, 5e5)}
    typical = [scales[next(key for key in scales if name.startswith(key))] for name in metadata["parameters"]["inputs"]]
    batch = 64
    windows = numpy.stack([mean + size * rng.standard_normal((batch, steps)) for mean, size in typical], axis=-1)

    # The same numbers as /v1 gives, window by window.
    direct = numpy.empty((batch, len(targets)))
    for number, window in enumerate(windows):
        signals = {name: list(window[:, i]) for i, name in enumerate(metadata["parameters"]["inputs"])}
        answer = service.ask(f"/v1/models/{model}/predict", {"inputs": signals})
        direct[number] = [answer["estimates"][target][0] for target in targets]
    tolerance = 1e-6 * numpy.ptp(direct, axis=0)

    for binary_in in (True, False):
        for binary_out in (True, False):
            for compression in (None, "gzip", "deflate"):
                outputs = [triton.InferRequestedOutput("estimates", binary_data=binary_out),
                           triton.InferRequestedOutput("inside_envelope", binary_data=binary_out)]
                answer = client.infer(
                    model, [window_input(windows, binary=binary_in)], outputs=outputs, request_id="17",
                    request_compression_algorithm=compression, response_compression_algorithm=compression,
                )
                assert answer.get_response()["id"] == "17"
                estimates = answer.as_numpy("estimates")
                assert estimates.shape == (batch, len(targets))
                assert (numpy.abs(estimates - direct) <= tolerance).all()
                assert answer.as_numpy("inside_envelope").dtype == bool
    # Outputs not asked for by name: all of them.
    answer = client.infer(model, [window_input(windows[:1])])
    lower, upper = answer.as_numpy("lower"), answer.as_numpy("upper")
    if lower is not None:
        assert (lower < answer.as_numpy("estimates")).all() and (answer.as_numpy("estimates") < upper).all()
    single = client.infer(model, [window_input(windows, datatype="FP32")]).as_numpy("estimates")
    assert (numpy.abs(single - direct) <= 100 * tolerance).all(), "single precision of pressures"

    for tensors, words in [
        ([window_input(windows[:, 1:])], "[batch,"),
        ([window_input(windows, name="x")], "window"),
        ([window_input(windows), window_input(windows, name="y")], "takes one"),
        ([window_input(windows * numpy.nan)], "NaN at [0, 0, 0]"),
    ]:
        try:
            client.infer(model, tensors)
            raise AssertionError(f"not refused: {words}")
        except triton.InferenceServerException as error:
            assert words in str(error), str(error)
    try:
        client.infer("nobody@stable", [window_input(windows)])
        raise AssertionError("an unknown model answered")
    except triton.InferenceServerException as error:
        assert error.status() in ("404", 404, None) and "nobody@stable" in str(error), str(error)
    client.close()
    return windows, direct


def main():
    with tempfile.TemporaryDirectory() as folder:
        service = Service(folder)
        try:
            model = trained_model(service)
            check(service, model)
            alias = service.ask("/v1/aliases/boom@stable", {"model_id": model}, "PUT")
            assert alias["generation"] == 1
            windows, direct = check(service, "boom@stable")
            client = triton.InferenceServerClient(service.url.removeprefix("http://"))
            for name, version in [("boom@stable", "1"), ("boom", "stable"), (model, "1")]:
                answer = client.infer(name, [window_input(windows)], model_version=version)
                assert (answer.as_numpy("estimates") == client.infer(model, [window_input(windows)]).as_numpy("estimates")).all()
                assert client.is_model_ready(name, version)
            try:
                client.get_model_metadata("boom@stable", "2")
                raise AssertionError("a version that is not there")
            except triton.InferenceServerException as error:
                assert "version" in str(error)
            client.close()
            # Killed without a word, started again: the same names, the same answers.
            service.kill()
            begun = time.monotonic()
            service.start()
            client = triton.InferenceServerClient(service.url.removeprefix("http://"))
            estimates = client.infer("boom@stable", [window_input(windows)]).as_numpy("estimates")
            print(f"killed and serving again after {time.monotonic() - begun:.3f} s")
            assert (numpy.abs(estimates - direct) <= 1e-6 * numpy.ptp(direct, axis=0)).all()
            client.close()
        finally:
            service.kill()
    print("tritonclient: all as it should be")


if __name__ == "__main__":
    sys.exit(main())
