#!/bin/sh
# Runs every fuzz target for SECONDS each (60 unless told):
#
#     tests/fuzz/all.sh [SECONDS] [TARGET...]
#
# Installs the nightly compiler and cargo-fuzz where they are missing. What is found lies in
# tests/fuzz/artifacts, what was learned in tests/fuzz/corpus. `FUZZ_FEATURES=` leaves the service out, whose
# instrumented build takes long.
set -eu
cd "$(dirname "$0")"
seconds=${1:-60}
[ $# -gt 0 ] && shift
rustup toolchain list | grep -q '^nightly' || rustup toolchain install nightly --profile minimal
cargo fuzz --version >/dev/null 2>&1 || cargo install --locked cargo-fuzz
features=${FUZZ_FEATURES-service}

parsers="machine mesh job manifest shard"
bodies="infer_json infer_bytes predict_json predict_arrow predict_parquet stream submit training upload cursor"
[ -n "$features" ] || bodies=
[ $# -gt 0 ] || set -- $parsers $bodies

log=$(mktemp)
trap 'rm -f "$log"' EXIT
for target; do
    mkdir -p "corpus/$target" "seeds/$target"
    case $target in
    machine) seeds=../../sim/machines ;;
    upload) seeds=seeds/mesh ;;
    *) seeds=seeds/$target ;;
    esac
    echo "== $target"
    # Sanitizers are for unsafe code and C: the kernels have their own tests, and parsing is safe Rust.
    status=0
    cargo +nightly fuzz run --fuzz-dir . --sanitizer none ${features:+--features "$features"} "$target" "corpus/$target" "$seeds" -- \
        -max_total_time="$seconds" -rss_limit_mb=2048 -timeout=10 -max_len=16384 -print_final_stats=1 >"$log" 2>&1 || status=$?
    if [ "$status" -ne 0 ]; then
        tail -n 60 "$log"
        echo "$target: failed; what was found, if anything, is in tests/fuzz/artifacts/$target"
        exit 1
    fi
    grep -E '^(stat::number_of_executed_units|stat::peak_rss_mb)' "$log"
done
