#!/usr/bin/env bash
# Installs the Debian packages that `make demo` (argument: run) or `make test` (argument: test) needs and that are missing.
# Without the right to install, it names them in one sentence: an error for what the build cannot do without.
set -eu

need_build=()
need_test=()
command -v c++ >/dev/null || need_build+=(g++)
command -v git >/dev/null || need_build+=(git)
"${PYTHON:-python3}" -c 'import venv, ensurepip' 2>/dev/null || need_build+=(python3-venv)
"${PYTHON:-python3}" - 2>/dev/null <<'PY' || need_build+=(python3-dev)
import pathlib, sys, sysconfig
sys.exit(not pathlib.Path(sysconfig.get_path("include"), "Python.h").exists())
PY
ls /usr/lib/*/libLLVM*19* >/dev/null 2>&1 || need_test+=(libllvm19)
command -v chromium >/dev/null || need_test+=(chromium)

need=("${need_build[@]}")
[ "${1:-run}" = test ] && need+=("${need_test[@]}")
[ "${#need[@]}" -eq 0 ] && exit 0

run=()
[ "$(id -u)" -eq 0 ] || run=(sudo -n)
if command -v apt-get >/dev/null && "${run[@]}" true 2>/dev/null; then
    echo "Installing system packages: ${need[*]}"
    "${run[@]}" apt-get update -qq
    DEBIAN_FRONTEND=noninteractive "${run[@]}" apt-get install -y -qq --no-install-recommends "${need[@]}" >/dev/null
else
    echo "Please install these system packages and run make again: ${need[*]}" >&2
    exit 1
fi
