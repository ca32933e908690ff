"""Seconds per epoch of training, beside PyTorch at its best (all windows in one tensor, fused Adam) on the same windows,
batches, learning rates and numbers of threads, and the losses of both. Run by `tests/heavy.sh --bench`.

Ours is timed as the difference between a long and a short training of as many validations, so that these do not count;
PyTorch's loop is timed after one epoch. Rounds take turns and have a seed each; the median of the ratios is shown. Two cores
of a shared machine: the ratios count.
"""
import argparse
import json
import math
import os
import pathlib
import resource
import shutil
import statistics
import subprocess
import tempfile
import time

import matplotlib
import matplotlib.pyplot
import numpy as np
import pyarrow.parquet as pq
import torch

HYDROFLEX = os.environ.get("HYDROFLEX_BIN", "target/release/hydroflex")
ACTIVATIONS = {"tanh": torch.nn.Tanh, "sigmoid": torch.nn.Sigmoid, "relu": torch.nn.ReLU, "elu": torch.nn.ELU, "silu": torch.nn.SiLU}
WINDOW_STEPS, TARGET = 60, "deflection_tip_y_m"
# Windows, batch, epochs of the short and of the long training and of PyTorch's. A training validates fifty times: as often in
# the short as in the long one where both have at least fifty epochs. With all windows an epoch is long, and ours validates
# after each: the ratio is then a lower bound.
CASES = {"disjoint": (768, 50, 250, 250), "overlapping": (1024, 1, 5, 2)}


def children_s():
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def ours(data, scratch, structure, windows, epochs, threads, seed):
    """Seconds of the training, seconds of processor time of the process, config.json."""
    batch = CASES[windows][0]
    model = scratch / f"model-{time.monotonic_ns()}"
    used = children_s()
    run = subprocess.run(
        [HYDROFLEX, "train", "--data", data, "--out", model, "--structure", structure, "--targets", TARGET, "--window-s",
         str(WINDOW_STEPS * 0.005), "--windows", windows, "--batch", str(batch), "--learning-rate", "1e-3", "--epochs", str(epochs),
         "--seed", str(seed), "--json"],
        check=True, capture_output=True, env={**os.environ, "RAYON_NUM_THREADS": str(threads)})
    used = children_s() - used
    config = json.loads((model / "config.json").read_text())
    assert config["provenance"]["epochs"] == epochs, config["provenance"]["ended_by"]
    shutil.rmtree(model)
    return json.loads(run.stdout)["train_seconds"], used, config


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


def dense(config):
    modules = []
    for layer in config["layers"]:
        modules += [torch.nn.Linear(layer["inputs"], layer["outputs"]), *(ACTIVATIONS[name]() for name in layer["activations"])]
    return torch.nn.Sequential(*modules)


def theirs(x, y, config, windows, epochs, threads, seed):
    """Seconds and seconds of processor time per epoch, and the mean loss of each epoch."""
    batch = CASES[windows][0]
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    net = config if isinstance(config, torch.nn.Module) else dense(config)
    adam = torch.optim.Adam(net.parameters(), lr=1e-3, eps=1e-8, fused=True)
    # As ours: a constant rate with the published windows, a cosine with all.
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, epochs * -(-len(x) // batch)) if windows == "overlapping" else None
    losses = []
    for epoch in range(epochs):
        if epoch == 1:
            begun, used = time.monotonic(), time.process_time()
        order, total = torch.randperm(len(x)), 0.0
        for some in order.split(batch):
            adam.zero_grad()
            loss = torch.nn.functional.mse_loss(net(x[some]), y[some])
            loss.backward()
            adam.step()
            if schedule:
                schedule.step()
            total += loss.detach() * len(some)
        losses.append(float(total) / len(x))
    return (time.monotonic() - begun) / (epochs - 1), (time.process_time() - used) / (epochs - 1), losses


def round_of(data, scratch, x, y, structure, windows, threads, seed):
    _, short, long, epochs = CASES[windows]

    def one():
        few_s, few_used, _ = ours(data, scratch, structure, windows, short, threads, seed)
        many_s, many_used, config = ours(data, scratch, structure, windows, long, threads, seed)
        history = {record["epoch"]: record["train_loss"] for record in config["provenance"]["history"]}
        return (many_s - few_s) / (long - short), (many_used - few_used) / (long - short), history

    if seed % 2:
        a, b = one(), theirs(x, y, CONFIGS[structure], windows, epochs, threads, seed)
    else:
        b = theirs(x, y, CONFIGS[structure], windows, epochs, threads, seed)
        a = one()
    return a, b


class Recurrent(torch.nn.Module):
    """RNN or LSTM over the samples of a window, width 64; the last output decides. As `hydroflex` has them."""

    def __init__(self, kind, channels, width=64):
        super().__init__()
        self.channels, self.cell = channels, getattr(torch.nn, kind)(channels, width, batch_first=True)
        self.last = torch.nn.Linear(width, 1)

    def forward(self, x):
        return self.last(self.cell(x.reshape(len(x), -1, self.channels))[0][:, -1])


class Convolutional(torch.nn.Module):
    """Two convolutions of 5 samples and stride 2 with 32 and 64 channels, ReLU, and a linear layer."""

    def __init__(self, channels, width=64):
        super().__init__()
        self.channels = channels
        options = {"kernel_size": 5, "stride": 2, "padding": 2}
        left = -(-(-(-WINDOW_STEPS // 2)) // 2)
        self.net = torch.nn.Sequential(
            torch.nn.Conv1d(channels, width // 2, **options), torch.nn.ReLU(), torch.nn.Conv1d(width // 2, width, **options), torch.nn.ReLU(),
            torch.nn.Flatten(), torch.nn.Linear(width * left, 1))

    def forward(self, x):
        return self.net(x.reshape(len(x), -1, self.channels).transpose(1, 2))


def comparison(scratch, structure, rounds, threads):
    """A line on a network for comparison: hydroflex trains these in its study only, on all windows, and judges them after."""
    few, many = 1, 3

    def one(epochs):
        out = scratch / "study"
        cell = out / "0kg" / f"all-{structure}-0.json"
        cell.unlink(missing_ok=True)
        subprocess.run(
            [HYDROFLEX, "reproduce-paper", "--machine", "lift-boom", "--payloads", "0", "--sensors", "all", "--targets", TARGET,
             "--structures", structure, "--seeds", "1", "--epochs", str(epochs), "--out", out, "--json"],
            check=True, capture_output=True, env={**os.environ, "RAYON_NUM_THREADS": str(threads)})
        return json.loads(cell.read_text())[0]["train_seconds"], out / "0kg" / "training"

    times, count = [], 0
    for seed in range(rounds):
        (short_s, data), (long_s, _) = one(few), one(many)
        table = pq.read_table(next((data / "data").glob("train-*.parquet")))
        names = [n for n in table.column_names if n.split("_")[0] in ("valve", "length", "velocity", "pressure")]
        scale = [{"name": n, "offset": table[n].to_numpy().mean(), "scale": table[n].to_numpy().std() or 1.0} for n in [*names, TARGET]]
        x, y = tensors(data, {"inputs": scale[:-1], "targets": scale[-1:]}, "overlapping")
        count = len(x)
        net = Convolutional(len(names)) if structure == "CNN" else Recurrent(structure, len(names))
        times.append(((long_s - short_s) / (many - few), theirs(x, y, net, "overlapping", 2, threads, seed)[0]))
    ratios = [b / a for a, b in times]
    return (f"| {count:,} overlapping | {CASES['overlapping'][0]} | {structure} | {threads} | {ms([b for _, b in times])} | {ms([a for a, _ in times])} "
            f"| **{statistics.median(ratios):.2f}** ({min(ratios):.2f}, {max(ratios):.2f}) | | | |")


def ms(values):
    return f"{statistics.median(values) * 1e3:.1f}"


def spread(values):
    return f"{statistics.median(values):.2e} ({min(values):.1e}, {max(values):.1e})"


def late(history):
    """Geometric mean of the last fifth of the recorded losses: at a constant rate single ones jump."""
    last = list(history.values())[-max(len(history) // 5, 1):]
    return math.exp(statistics.fmean(math.log(loss) for loss in last))


CONFIGS = {}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--structures", nargs="*", default=["L", "RLR", "ELE", "TLTLT", "TLSLTLSLT"])
    parser.add_argument("--overlapping", nargs="*", default=["RLR"], help="structures that are also trained on all windows")
    parser.add_argument("--comparisons", nargs="*", default=["RNN", "LSTM", "CNN"], help="networks for comparison, on one thread")
    parser.add_argument("--threads", nargs="*", type=int, default=[1, 2])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--data", type=pathlib.Path, help="the data set, if it is at hand")
    parser.add_argument("--out", help="report; the picture of the losses comes to stand beside it")
    arguments = parser.parse_args()
    speeds, losses, curves = [], [], {}
    with tempfile.TemporaryDirectory() as scratch:
        scratch = pathlib.Path(scratch)
        data = arguments.data or dataset(scratch)
        cases = [("disjoint", s) for s in arguments.structures] + [("overlapping", s) for s in arguments.overlapping]
        for windows, structure in cases:
            CONFIGS[structure] = config = ours(data, scratch, structure, windows, 1, 1, 0)[2]
            x, y = tensors(data, config, windows)
            assert len(x) == config["provenance"]["train_windows"], (len(x), config["provenance"]["train_windows"])
            for threads in arguments.threads:
                rounds = [round_of(data, scratch, x, y, structure, windows, threads, seed) for seed in range(arguments.rounds)]
                ours_, theirs_ = zip(*rounds)
                ratios = [b[0] / a[0] for a, b in rounds]
                used = [b[1] / a[1] for a, b in rounds]
                speeds.append(f"| {len(x):,} {windows} | {CASES[windows][0]} | {structure} | {threads} | {ms([b[0] for b in theirs_])} | {ms([a[0] for a in ours_])} "
                              f"| **{statistics.median(ratios):.2f}** ({min(ratios):.2f}, {max(ratios):.2f}) | {ms([b[1] for b in theirs_])} | {ms([a[1] for a in ours_])} | {statistics.median(used):.2f} |")
                print(speeds[-1], flush=True)
                if windows == "disjoint" and threads == arguments.threads[0]:
                    pairs = [(a[2], {epoch: b[2][epoch - 1] for epoch in a[2]}) for a, b in rounds]
                    curves[structure] = pairs
                    losses.append(f"| {structure} | {spread([late(b) for _, b in pairs])} | {spread([late(a) for a, _ in pairs])} |")
                    print(losses[-1], flush=True)
        for structure in arguments.comparisons:
            speeds.append(comparison(scratch, structure, arguments.rounds, arguments.threads[0]))
            print(speeds[-1], flush=True)
    if arguments.out:
        report(pathlib.Path(arguments.out), arguments.rounds, speeds, losses, curves)


def report(out, rounds, speeds, losses, curves):
    picture = out.with_suffix(".svg")
    same = []
    if curves:
        draw(picture, curves)
        same = [
            f"Both learn the same. Training loss (mean squared error, scaled) over the last fifth of {CASES['disjoint'][2]} epochs with 6,144 windows, learning rate",
            f"1e-3, median and range of {rounds} seeds; the two draw different weights and orders from a seed:", "",
            "| structure | PyTorch | hydroflex |", "|---|---|---|", *losses, "",
            f"![Training losses of both, {rounds} seeds each]({picture.name})"]
    out.write_text("\n".join([
        "# Training, beside PyTorch", "",
        f"PyTorch {torch.__version__} at its best (all windows in one tensor, fused Adam) and `hydroflex train`, by `tests/heavy.sh --bench`: window of",
        f"{WINDOW_STEPS} samples × 5 sensors, width {WINDOW_STEPS}, 2,048 training runs of the built-in boom. Milliseconds per epoch, medians of {rounds} rounds that take turns;",
        "two cores of a shared machine, so the ratios count. Processor time beside time. With overlapping windows ours validates after",
        "each epoch, PyTorch does not: that ratio is a lower bound. Two threads need both cores for themselves: where a neighbour takes",
        "one, PyTorch's threads wait for each other, actively, and the ratio says more about the neighbour.", "",
        "| windows | batch | structure | threads | PyTorch, ms | hydroflex, ms | ratio (least, most) | PyTorch, CPU ms | hydroflex, CPU ms | ratio |",
        "|---|---:|---|---:|---:|---:|---|---:|---:|---:|", *speeds, "", *same]) + "\n")


def draw(picture, curves):
    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "hydroflex", "font.size": 8})
    figure, axes = matplotlib.pyplot.subplots(1, len(curves), figsize=(2.3 * len(curves), 2.6), sharey=True, squeeze=False)
    for axis, (structure, pairs) in zip(axes[0], curves.items()):
        for position, (name, color) in enumerate((("hydroflex", "#0b6e4f"), ("PyTorch", "#d1495b"))):
            epochs = list(pairs[0][position])
            values = np.array([list(pair[position].values()) for pair in pairs])
            axis.fill_between(epochs, values.min(0), values.max(0), color=color, alpha=0.2, linewidth=0)
            axis.semilogy(epochs, np.median(values, 0), color=color, linewidth=1.2, label=name)
        axis.set(title=structure, xlabel="epoch")
        axis.grid(alpha=0.3, linewidth=0.5)
    axes[0][0].set_ylabel("training loss")
    axes[0][-1].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(picture, metadata={"Date": None})


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
