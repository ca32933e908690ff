"""Model folders in PyTorch: `model.safetensors` loads strictly into the modules that `config.json` describes, and gives
the estimates of `hydroflex predict`; a data set feeds a `DataLoader`. Run by tests/heavy.sh.
"""
import json
import math
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from safetensors.torch import load_file

HYDROFLEX = os.environ["HYDROFLEX_BIN"]
STRUCTURES = ["L", "RLR", "ELE", "TLTLT", "TLSLTLSLT", "best"]
ACTIVATIONS = {"tanh": torch.nn.Tanh, "sigmoid": torch.nn.Sigmoid, "relu": torch.nn.ReLU, "elu": torch.nn.ELU, "silu": torch.nn.SiLU}


class Slide(torch.nn.Module):
    """The network of a model folder, and its linear map where it has one."""

    def __init__(self, config):
        super().__init__()
        modules = []
        for layer in config["layers"]:
            assert layer["name"] == f"net.{len(modules)}", "names are those of a Sequential"
            modules.append(torch.nn.Linear(layer["inputs"], layer["outputs"]))
            modules += [ACTIVATIONS[name]() for name in layer["activations"]]
        self.net = torch.nn.Sequential(*modules)
        targets, self.steps = len(config["targets"]), config.get("output_steps", 1)
        size = (config["window_steps"] + 1 - self.steps) * len(config["inputs"])

        def linear(schedule, targets):
            return torch.nn.Linear(size, (len(schedule["exponents"]) if schedule else 1) * targets, dtype=torch.float64)

        if config["linear_skip"]:
            self.skip = linear(config.get("schedule"), targets)
        if payload := config.get("payload"):
            self.payload = torch.nn.ModuleList(linear(schedule, 1) for schedule in payload["estimates"])
            if payload.get("empty"):
                self.empty = linear(payload["empty"]["schedule"], targets)
        if config.get("guard"):
            size = config["window_steps"] * len(config["inputs"])
            self.guard = torch.nn.Linear(size, len(config["targets"]))
        self.config = config

    def scheduled(self, linear, schedule, x, raw_last, estimate):
        """A linear map whose coefficients follow slow signals, and an estimate of the payload."""
        if not schedule:
            return linear(x)
        terms = linear(x).reshape(len(x), len(schedule["exponents"]), -1)
        columns = zip(schedule["inputs"], schedule["centre"], schedule["half_range"])
        u = [((raw_last[:, i] - c) / h).clamp(-1, 1) for i, c, h in columns] + ([] if estimate is None else [estimate.clamp(-1, 1)])
        factors = torch.ones(terms.shape[:2], dtype=torch.float64)
        for place, exponents in enumerate(schedule["exponents"]):
            for signal, exponent in zip(u, exponents):
                factors[:, place] *= signal**exponent
        return (terms * factors[:, :, None]).sum(1)

    def linear_part(self, x, raw_last):
        payload, estimate = self.config.get("payload"), None
        for linear, schedule in zip(self.payload, payload["estimates"]) if payload else ():
            estimate = self.scheduled(linear, schedule, x, raw_last, estimate)[:, 0]
        y, gain = self.scheduled(self.skip, self.config.get("schedule"), x, raw_last, estimate), 1.0
        if payload and (empty := payload.get("empty")):
            below = (empty["below_kg"] - payload["centre_kg"]) / payload["half_range_kg"]
            is_empty = (estimate < below)[:, None]
            y = torch.where(is_empty, self.scheduled(self.empty, empty["schedule"], x, raw_last, None), y)
            gain = torch.where(is_empty, torch.tensor(empty["network_gain"], dtype=torch.float64), 1.0)
        return y, gain

    def forward(self, x, raw_last):
        """Scaled windows and the sensors at their ends to estimates in physical units."""
        config = self.config
        # A model's inputs are f32: the linear map's large coefficients would show what rounding takes.
        x = x.float().double()
        # Of several estimated samples the last is the estimate; the linear map takes the samples up to it.
        y = self.net(x.float()).double()[:, -len(config["targets"]):]
        if config["linear_skip"]:
            linear, gain = self.linear_part(x[:, (self.steps - 1) * len(config["inputs"]):], raw_last)
            y = gain * y + linear
        if guard := config.get("guard"):
            offset, scale = column_of(config["targets"], "offset"), column_of(config["targets"], "scale")
            guide, slack = self.guard(x.float()).double(), torch.tensor(guard["slack"]) / scale
            y = torch.clamp(y, guide - slack, guide + slack)
            y = torch.clamp(y, (torch.tensor(guard["min"]) - offset) / scale, (torch.tensor(guard["max"]) - offset) / scale)
        return y * column_of(config["targets"], "scale") + column_of(config["targets"], "offset")


def column_of(channels, key):
    return torch.tensor([channel[key] for channel in channels], dtype=torch.float64)


def make(folder, name="set", runs=24, payload_kg=lambda run: 50.0):
    rng = np.random.default_rng(5)
    steps = 200
    signals = [np.clip(np.cumsum(rng.normal(0, 0.15, steps)), -1, 1) for _ in range(runs)]
    table = pa.table({
        "run_id": pa.array(range(runs), pa.uint64()),
        "payload_kg": [float(payload_kg(run)) for run in range(runs)],
        "angle_lift_rad": [math.radians(36 * run / runs) for run in range(runs)],
        "valve_lift_ratio": pa.array(signals, pa.list_(pa.float64())),
    })
    pq.write_table(table, folder / "runs.parquet")
    subprocess.run([HYDROFLEX, "simulate", "--runs", folder / "runs.parquet", "--out", folder / name], check=True, capture_output=True)
    return folder / name


class Windows(torch.utils.data.Dataset):
    """Every window of every run, cut when it is asked for; the last sample's targets belong to it."""

    def __init__(self, data, inputs, targets, steps):
        table = pq.read_table(next((data / "data").glob("train-*.parquet")))
        self.x = torch.tensor(np.stack([table[name].to_numpy() for name in inputs], 1))
        self.y = torch.tensor(np.stack([table[name].to_numpy() for name in targets], 1))
        run, step = table["run_id"].to_numpy(), table["step"].to_numpy()
        self.ends = np.flatnonzero(step >= steps - 1)
        assert all(run[end] == run[end - steps + 1] for end in self.ends)
        self.steps = steps

    def __len__(self):
        return len(self.ends)

    def __getitem__(self, place):
        end = self.ends[place]
        return self.x[end - self.steps + 1 : end + 1], self.y[end]


def check_model(folder, data, structure):
    model = folder / f"model-{structure}"
    subprocess.run([HYDROFLEX, "train", "--data", data, "--out", model, "--structure", structure, "--window-s", "0.2",
                    "--epochs", "3"], check=True, capture_output=True)
    config = json.loads((model / "config.json").read_text())
    module = Slide(config)
    module.load_state_dict(load_file(model / "model.safetensors"), strict=True)
    recording = next((data / "data").glob("validation-*.parquet"))
    out = folder / f"estimates-{structure}.parquet"
    subprocess.run([HYDROFLEX, "predict", "--model", model, "--data", recording, "--out", out], check=True, capture_output=True)
    samples, estimates = pq.read_table(recording), pq.read_table(out)
    steps, names = config["window_steps"], [channel["name"] for channel in config["inputs"]]
    raw = torch.tensor(np.stack([samples[name].to_numpy() for name in names], 1))
    ends = np.flatnonzero(samples["step"].to_numpy() >= steps - 1)
    ends = ends[estimates["inside_envelope"].to_numpy(zero_copy_only=False)[ends].astype(bool)]
    assert len(ends) > 100, f"{structure}: {len(ends)} windows inside the envelope"
    scaled = (raw - column_of(config["inputs"], "offset")) * (1 / column_of(config["inputs"], "scale"))
    windows = torch.stack([scaled[end - steps + 1 : end + 1].reshape(-1) for end in ends])
    with torch.no_grad():
        seen = scaled.float().double() * column_of(config["inputs"], "scale") + column_of(config["inputs"], "offset")
        found = module(windows, seen[ends]).numpy()
    for place, target in enumerate(config["targets"]):
        ours = estimates[target["name"]].to_numpy()[ends]
        spread = np.ptp(samples[target["name"]].to_numpy())
        difference = np.max(np.abs(ours - found[:, place])) / spread
        print(f"{structure:10} {target['name']:20} {difference:.1e} of range", flush=True)
        assert difference < 1e-5, difference
    return config


def check_loader(data):
    inputs, targets, steps = ["valve_lift_ratio", "length_lift_m"], ["deflection_tip_y_m"], 40
    windows = Windows(data, inputs, targets, steps)
    loader = torch.utils.data.DataLoader(windows, batch_size=256, shuffle=True, num_workers=2)
    seen, total = 0, 0.0
    for x, y in loader:
        assert x.shape[1:] == (steps, 2) and y.shape[1:] == (1,) and x.dtype == torch.float64
        seen, total = seen + len(x), total + float(y.sum())
    assert seen == len(windows)
    assert math.isclose(total, float(windows.y[windows.ends].sum()), rel_tol=1e-9)
    print(f"DataLoader: {seen} windows")


def main():
    with tempfile.TemporaryDirectory() as scratch:
        folder = pathlib.Path(scratch)
        data = make(folder)
        check_loader(data)
        for structure in STRUCTURES:
            check_model(folder, data, structure)
        # Payloads that the network has to find out, a third of the runs without any.
        mixed = make(folder, "mixed", 300, lambda run: 0 if run % 3 == 0 else 7.3 * run % 100)
        shutil.rmtree(folder / "model-best")
        config = check_model(folder, mixed, "best")
        assert config["payload"]["empty"], "the payload is followed"
    print("passed")


if __name__ == "__main__":
    sys.exit(main())
