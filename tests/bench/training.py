"""Seconds per epoch of training, beside PyTorch at its best (all windows in one tensor, fused Adam) on the same windows,
batches, learning rates and numbers of threads. Run by `tests/heavy.sh --bench`.

Both are timed as the difference between a long and a short training, so that reading and preparing do not count; rounds take
turns, the median of the ratios is shown. Two cores of a shared machine: the ratios count.
"""
import argparse
import json
import os
import pathlib
import statistics
import subprocess
import tempfile
import time

import numpy as np
import pyarrow.parquet as pq
import torch

HYDROFLEX = os.environ.get("HYDROFLEX_BIN", "target/release/hydroflex")
ACTIVATIONS = {"tanh": torch.nn.Tanh, "sigmoid": torch.nn.Sigmoid, "relu": torch.nn.ReLU, "elu": torch.nn.ELU, "silu": torch.nn.SiLU}
WINDOW_STEPS, TARGET = 60, "deflection_tip_y_m"
# Windows, batch, epochs of the short and of the long training. A training validates fifty times, on all windows of the
# validation runs, or after each epoch where it has fewer: both have at least fifty, so that it cancels out.
CASES = {"disjoint": (768, 60, 160), "overlapping": (1024, 50, 60)}


def ours(data, scratch, structure, windows, epochs, threads, seed):
    batch = CASES[windows][0]
    model = scratch / f"model-{time.monotonic_ns()}"
    begun = time.monotonic()
    subprocess.run(
        [HYDROFLEX, "train", "--data", data, "--out", model, "--structure", structure, "--targets", TARGET, "--window-s",
         str(WINDOW_STEPS * 0.005), "--windows", windows, "--batch", str(batch), "--learning-rate", "1e-3", "--epochs", str(epochs),
         "--seed", str(seed)],
        check=True, capture_output=True, env={**os.environ, "RAYON_NUM_THREADS": str(threads)})
    return time.monotonic() - begun, json.loads((model / "config.json").read_text())


def tensors(data, config, windows):
    table = pq.read_table(next((data / "data").glob("train-*.parquet")))
    columns = [(table[c["name"]].to_numpy() - c["offset"]) / c["scale"] for c in config["inputs"]]
    target = config["targets"][0]
    x, y = np.stack(columns, 1).astype(np.float32), (table[TARGET].to_numpy() - target["offset"]) / target["scale"]
    step = table["step"].to_numpy()
    ends = np.flatnonzero(step >= WINDOW_STEPS - 1)
    if windows == "disjoint":
        ends = ends[(step[ends] + 1) % WINDOW_STEPS == 0]
    windows = np.lib.stride_tricks.sliding_window_view(x, WINDOW_STEPS, 0)[ends - WINDOW_STEPS + 1].transpose(0, 2, 1)
    return torch.tensor(windows.reshape(len(ends), -1).copy()), torch.tensor(y[ends, None].astype(np.float32))


def theirs(x, y, config, batch, epochs, threads, seed):
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    modules = []
    for layer in config["layers"]:
        modules += [torch.nn.Linear(layer["inputs"], layer["outputs"]), *(ACTIVATIONS[name]() for name in layer["activations"])]
    net = torch.nn.Sequential(*modules)
    adam = torch.optim.Adam(net.parameters(), lr=1e-3, eps=1e-8, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, epochs * -(-len(x) // batch))
    begun = time.monotonic()
    for _ in range(epochs):
        order, total = torch.randperm(len(x)), 0.0
        for some in order.split(batch):
            adam.zero_grad()
            loss = torch.nn.functional.mse_loss(net(x[some]), y[some])
            loss.backward()
            adam.step()
            schedule.step()
            total += loss.detach() * len(some)
    return time.monotonic() - begun, float(total) / len(x)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--structures", nargs="*", default=["L", "RLR", "ELE", "TLTLT", "TLSLTLSLT"])
    parser.add_argument("--windows", nargs="*", default=list(CASES))
    parser.add_argument("--threads", nargs="*", type=int, default=[1, 2])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out")
    arguments = parser.parse_args()
    lines = ["# Training, beside PyTorch", "", f"Seconds per epoch, medians of {arguments.rounds} rounds, PyTorch {torch.__version__}; window of {WINDOW_STEPS} samples × 5 sensors, 2,048",
             "training runs of the built-in boom, by `tests/heavy.sh --bench`. Loss: mean squared error of the last epoch, scaled.", "",
             "| windows | batch | structure | threads | PyTorch | hydroflex | ratio (least, most) | loss, PyTorch | loss, hydroflex |", "|---|---:|---|---:|---:|---:|---|---:|---:|"]
    with tempfile.TemporaryDirectory() as scratch:
        scratch = pathlib.Path(scratch)
        data = dataset(scratch)
        for windows in arguments.windows:
            batch, short, long = CASES[windows]
            for structure in arguments.structures:
                _, config = ours(data, scratch, structure, windows, 1, 1, 0)
                x, y = tensors(data, config, windows)
                assert len(x) == config["provenance"]["train_windows"], (len(x), config["provenance"]["train_windows"])
                for threads in arguments.threads:
                    a, b, losses = [], [], []
                    for turn in range(arguments.rounds):
                        (few, _), (many, config) = (ours(data, scratch, structure, windows, epochs, threads, turn) for epochs in (short, long))
                        a.append((many - few) / (long - short))
                        (few, _), (many, loss) = (theirs(x, y, config, batch, epochs, threads, turn) for epochs in (short, long))
                        b.append((many - few) / (long - short))
                        losses.append((loss, config["provenance"]["history"][-1]["train_loss"]))
                    ratios = [torch_s / our_s for our_s, torch_s in zip(a, b)]
                    lines.append(f"| {len(x):,} {windows} | {batch} | {structure} | {threads} | {statistics.median(b) * 1e3:.1f} ms | {statistics.median(a) * 1e3:.1f} ms "
                                 f"| {statistics.median(ratios):.2f} ({min(ratios):.2f}, {max(ratios):.2f}) | {statistics.median(l for l, _ in losses):.2e} | {statistics.median(l for _, l in losses):.2e} |")
                    print(lines[-1], flush=True)
    text = "\n".join(lines) + "\n"
    if arguments.out:
        pathlib.Path(arguments.out).write_text(text)


def dataset(scratch):
    """2,560 random runs of the built-in boom, by a service of their own."""
    (scratch / "job.json").write_text(json.dumps({"runs": 2560, "payload_kg": 50}))
    service = subprocess.Popen([HYDROFLEX, "serve", "--listen", "127.0.0.1:8791", "--workers", "2", "--data", scratch / "service"],
                               stderr=subprocess.DEVNULL)
    try:
        url = ["--url", "http://127.0.0.1:8791"]
        for _ in range(100):
            time.sleep(0.2)
            answer = subprocess.run([HYDROFLEX, "job", "submit", scratch / "job.json", "--wait", "--json", *url], capture_output=True, text=True)
            if answer.returncode == 0:
                break
        job = json.loads(answer.stdout)
        subprocess.run([HYDROFLEX, "dataset", "fetch", job["dataset_id"], "--out", scratch / "set", *url], check=True, capture_output=True)
    finally:
        service.terminate()
        service.wait()
    return scratch / "set"


if __name__ == "__main__":
    main()
