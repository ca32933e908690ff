"""onnxruntime runs model.onnx and gives the service's numbers: near the training signals, and far from them, where
estimates are held at their bounds."""

import json
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import urllib.request

import numpy
import onnxruntime
import pyarrow
import pyarrow.parquet

import test_triton

# Relative to the target's scale. Near: two ways to sum in f32. Far: held inputs make sums of hundreds of scales.
NEAR, FAR = 1e-5, 1e-3


def main():
    with tempfile.TemporaryDirectory() as folder:
        unknown_payload(pathlib.Path(folder))
    with tempfile.TemporaryDirectory() as folder:
        service = test_triton.Service(folder)
        try:
            test_triton.JOB["train"] = [
                {"structure": structure, "epochs": 3, "window": {"rule": "given", "window_s": 0.1}}
                for structure in ("best", "TLSLTLSLT", "TDLT", "best")
            ]
            for several in test_triton.JOB["train"][2:]:
                several["output_steps"] = 10
            test_triton.trained_model(service)
            for model in service.ask("/v1/models")["models"]:
                check(service, model["model_id"])
        finally:
            service.kill()
    print("onnxruntime: all as it should be")


def unknown_payload(folder):
    """A network that estimates the payload from the window, and has a map of its own without any: golden windows of all runs."""
    rng = numpy.random.default_rng(5)
    runs, steps = 400, 100
    signals = [numpy.clip(numpy.cumsum(rng.normal(0, 0.15, steps)), -1, 1) for _ in range(runs)]
    table = pyarrow.table({
        "run_id": pyarrow.array(range(runs), pyarrow.uint64()),
        "payload_kg": [0.0 if run % 3 == 0 else 100.0 * rng.random() for run in range(runs)],
        "angle_lift_rad": [math.radians(rng.uniform(0, 30)) for _ in range(runs)],
        "valve_lift_ratio": pyarrow.array(signals, pyarrow.list_(pyarrow.float64())),
    })
    pyarrow.parquet.write_table(table, folder / "runs.parquet")
    binary = os.environ.get("HYDROFLEX_BIN", "target/release/hydroflex")
    for arguments in (["simulate", "--machine", "lift-boom", "--runs", folder / "runs.parquet", "--out", folder / "set"],
                      ["train", "--data", folder / "set", "--out", folder / "model", "--epochs", "3", "--window-s", "0.2"],
                      ["train", "--data", folder / "set", "--out", folder / "several", "--epochs", "3", "--window-s", "0.2", "--output-steps", "5"]):
        subprocess.run([binary, *arguments], check=True, capture_output=True)
    for model in (folder / "model", folder / "several"):
        config = json.loads((model / "config.json").read_text())
        assert config["payload"]["empty"] and len(config["payload"]["estimates"]) == 4, "the payload is followed"
        session = onnxruntime.InferenceSession(model / "model.onnx", providers=["CPUExecutionProvider"])
        windows = numpy.array([golden["window"] for golden in config["golden"]])
        windows = windows.reshape(-1, config["window_steps"], len(config["inputs"]))
        ours = numpy.array([golden["estimates"] for golden in config["golden"]])
        scale = numpy.array([channel["scale"] for channel in config["targets"]])
        theirs = session.run(["estimates"], {"window": windows})[0]
        assert (numpy.abs(ours - theirs) / scale).max() <= NEAR, "an unknown payload"


def check(service, model):
    def file(name):
        with urllib.request.urlopen(f"{service.url}/v1/models/{model}/files/{name}") as answer:
            return answer.read()

    config = json.loads(file("config.json"))
    assert config["guard"], "estimates have bounds"
    session = onnxruntime.InferenceSession(file("model.onnx"), providers=["CPUExecutionProvider"])
    known = numpy.array([golden["window"] for golden in config["golden"]])
    known = known.reshape(len(known), config["window_steps"], len(config["inputs"]))
    rng = numpy.random.default_rng(3)
    scale = numpy.array([channel["scale"] for channel in config["targets"]])
    spread = numpy.array([channel["scale"] for channel in config["inputs"]])
    limited = 0
    if config.get("output_steps", 1) > 1:
        # Every estimated sample, the last of which is the estimate.
        all_steps, last = session.run(["all_steps", "estimates"], {"window": known})
        assert all_steps.shape == (len(known), config["output_steps"], len(config["targets"]))
        assert (numpy.abs(all_steps[:, -1] - last) / scale).max() < NEAR
    for windows, tolerance in [
        (known, NEAR),
        (known + 0.01 * spread * rng.standard_normal(known.shape), NEAR),
        (numpy.repeat(known, 20, 0) + 10 * spread * rng.standard_normal((20 * len(known), *known.shape[1:])), FAR),
    ]:
        ours = service.ask(
            f"/v2/models/{model}/infer",
            {"inputs": [{"name": "window", "datatype": "FP64", "shape": list(windows.shape), "data": windows.ravel().tolist()}]},
        )
        outputs = {output["name"]: numpy.array(output["data"]) for output in ours["outputs"]}
        ours = outputs["estimates"].reshape(len(windows), -1)
        theirs = session.run(["estimates"], {"window": windows})[0]
        worst = (numpy.abs(ours - theirs) / scale).max()
        assert worst <= tolerance, f"{config['structure']}: onnxruntime differs by {worst:.1e} of the scale"
        for target, (low, high) in enumerate(zip(config["guard"]["min"], config["guard"]["max"])):
            assert (low - 1e-6 * scale[target] <= theirs[:, target]).all() and (theirs[:, target] <= high + 1e-6 * scale[target]).all()
        limited += int((~outputs["inside_envelope"].astype(bool)).sum())
    assert limited >= 20 * len(known) - 1, "windows of noise are outside the envelope"


if __name__ == "__main__":
    sys.exit(main())
