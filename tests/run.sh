#!/usr/bin/env bash
# All tests: format, Rust tests, then the tools that people open our files with (Python, in a
# virtual environment made here). Needs the Rust toolchain and python3; installs the rest below target/.
#
#   tests/run.sh             everything
#   tests/run.sh --rust      Rust only: no Python, and no S3 unless HYDROFLEX_MOTO names moto's server program
#
# HYDROFLEX_REFERENCE=DIR adds the comparison with an independent solver's trajectories,
# HYDROFLEX_ACCEPTANCE=DIR the script that judges them.
set -euo pipefail
cd "$(dirname "$0")/.."
rust_only=false
for argument in "$@"; do
    case "$argument" in
        --rust) rust_only=true ;;
        *) echo "unknown argument: $argument (allowed: --rust)" >&2; exit 2 ;;
    esac
done

say() { printf '\n== %s\n' "$*"; }
passed=0
failed=0
count() { # passed failed
    passed=$((passed + $1))
    failed=$((failed + $2))
}

say "format"
cargo fmt --all --check

if ! $rust_only; then
    say "Python packages"
    venv=target/test-venv
    if [ ! -x "$venv/bin/python" ]; then python3 -m venv "$venv"; fi
    # Not the pip script: it names the place where the environment was made, which a copy is not.
    install() { "$venv/bin/python" -m pip install --quiet --disable-pip-version-check -r tests/python/requirements.txt; }
    install
    # The programs that came with the packages name that place too: a copy is made anew.
    if ! "$venv/bin/moto_server" --help >/dev/null 2>&1; then python3 -m venv --clear "$venv" && install; fi
    # An S3 server for the Rust tests.
    export HYDROFLEX_MOTO="$PWD/$venv/bin/moto_server"
fi

say "Rust tests (they share the build of every dependency with 'cargo run --release')"
log=$(mktemp)
trap 'rm -f "$log"' EXIT
set +e
cargo test --release --workspace --no-fail-fast 2>&1 | tee "$log"
rust_status=${PIPESTATUS[0]}
set -e
count $(awk '/^test result:/ { for (i = 1; i < NF; i++) { if ($(i+1) ~ /^passed/) p += $i; if ($(i+1) ~ /^failed/) f += $i } } END { print p+0, f+0 }' "$log")
# A crate that does not compile reports no result line: the exit status still counts.
if [ "$rust_status" -ne 0 ] && [ "$failed" -eq 0 ]; then count 0 1; fi

if ! $rust_only; then
    say "tools people use (Python)"
    # The Rust tests have built the binary; another `cargo build` would unify features anew and build burn again.
    for script in tests/python/test_*.py; do
        say "$script"
        if HYDROFLEX_BIN="$PWD/target/release/hydroflex" "$venv/bin/python" "$script"; then count 1 0; else count 0 1; fi
    done
fi

printf '\n%d passed, %d failed\n' "$passed" "$failed"
[ "$failed" -eq 0 ]
