#!/usr/bin/env bash
# What needs PyTorch (from PyPI with its CUDA libraries, some 6 GB): model folders and data sets in PyTorch, and how
# fast networks are trained beside it. Not part of the default tests, which check against numpy and onnxruntime.
#
#   tests/heavy.sh           the checks
#   tests/heavy.sh --bench   the checks, then the benchmark of training
set -euo pipefail
cd "$(dirname "$0")/.."
venv=${HYDROFLEX_HEAVY_VENV:-target/heavy-venv}
if [ ! -x "$venv/bin/python" ]; then python3 -m venv "$venv"; fi
"$venv/bin/pip" install --quiet --disable-pip-version-check torch numpy pyarrow safetensors matplotlib
if [ -z "${HYDROFLEX_BIN:-}" ]; then
    cargo build --release
    export HYDROFLEX_BIN=$PWD/target/release/hydroflex
fi
"$venv/bin/python" tests/python/heavy_torch.py
if [ "${1:-}" = "--bench" ]; then "$venv/bin/python" tests/bench/training.py; fi
