#!/usr/bin/env bash
# Builds tests/native/fuzz_core with sanitizers and runs it with every instruction set: sanitize.sh [rounds].
# Variables: PYTHON (finds nanobind), OUT (build folder). Ends with an error at the first report.
set -euo pipefail
cd "$(dirname "$0")/.."
rounds="${1:-200}"
out="${OUT:-out/sanitize}"
python="$(command -v "${PYTHON:-python3}")"
python="$(cd "$(dirname "$python")" && pwd)/$(basename "$python")"
cmake=cmake
if ! command -v cmake >/dev/null; then
    "$python" -m pip install -q --disable-pip-version-check cmake
    cmake="$(dirname "$python")/cmake"
fi

check() { # name, sanitizers
    "$cmake" -S . -B "$out/$1" -DPython_EXECUTABLE="$python" -DRF3DGS_SANITIZE="$2" >"$out-$1.log" || { cat "$out-$1.log"; exit 1; }
    "$cmake" --build "$out/$1" --target fuzz_core --parallel 2
    for set in portable avx2 avx512; do
        echo "$1: $set"
        RF3DGS_ISA="$set" "$out/$1/fuzz_core" "$rounds"
    done
}

mkdir -p "$out"
export UBSAN_OPTIONS=print_stacktrace=1
check address address,undefined,float-cast-overflow
# A fork of a process with threads is beyond ThreadSanitizer.
RF3DGS_FUZZ_NO_FORK=1 check thread thread
echo "no report"
