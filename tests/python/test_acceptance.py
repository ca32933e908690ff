"""`hydroflex simulate` against an independent solver's trajectories, judged by the script that comes with them.

Runs where HYDROFLEX_REFERENCE and HYDROFLEX_ACCEPTANCE name the reference data; says so and passes elsewhere:
the built-in boom's comparison with Exudyn (sim/tests) covers a clone without them.
"""
import os
import pathlib
import subprocess
import sys
import tempfile

# Scheme of ours, solution of the reference, tolerance, tolerance of accelerations (both relative to range).
# a and b are the same schemes at the same step: an independent Newton variant differs by 7e-8 and 2e-6.
# c is converged; `accurate` promises 1e-3.
CASES = [
    ("trapezoidal-index-2", "a", "1e-5", "1e-4"),
    ("generalized-alpha", "b", "1e-5", "1e-4"),
    ("accurate", "c", "1e-3", "1e-2"),
]


def main():
    reference, acceptance = os.environ.get("HYDROFLEX_REFERENCE"), os.environ.get("HYDROFLEX_ACCEPTANCE")
    if not reference or not acceptance:
        print("skipped: HYDROFLEX_REFERENCE and HYDROFLEX_ACCEPTANCE are not set")
        return 0
    boom = pathlib.Path(reference) / "liftboom"
    judge = [sys.executable, str(pathlib.Path(acceptance) / "trajectories.py")]
    failed = 0
    with tempfile.TemporaryDirectory() as scratch:
        runs = pathlib.Path(scratch) / "runs.parquet"
        subprocess.run([*judge, "run-table", boom, runs], check=True)
        for scheme, solution, tolerance, loose in CASES:
            out = pathlib.Path(scratch) / scheme
            subprocess.run([os.environ["HYDROFLEX_BIN"], "simulate", "--machine", "lift-boom-published",
                            "--mesh", boom / "Job-1.inp", "--runs", runs, "--out", out, "--integrator", scheme],
                           check=True)
            print(f"-- {scheme} against {solution}", flush=True)
            verdict = subprocess.run([*judge, "compare", boom, out, "--solution", solution, "--tolerance", tolerance,
                                      "--loose-tolerance", loose])
            failed += verdict.returncode != 0
    return failed


if __name__ == "__main__":
    sys.exit(main())
