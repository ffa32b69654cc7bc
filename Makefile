# make demo   set everything up and run the main job on the built-in lobby
# make test   set everything up and run the tests
# make test-isa  the core's tests with each of its instruction sets
# make sanitize  the core under the sanitizers
# make lint   formatting, types, import contract
# make bench  speed of the splatting core against this machine's floor and the reference, measured in the same run
# make twin   trace, photograph and train the built-in lobby afresh: the data that ships inside the package
#
# Variables: PYTHON (3.11 to 3.13), VENV, and TORCH_INDEX, the package index torch comes from: name PyTorch's CPU index
# for the small build, or one of its CUDA indexes for a GPU. Empty means pip's own configuration.

PYTHON ?= python3
VENV ?= .venv
TORCH_INDEX ?=
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
SOURCES := $(shell find native -type f 2>/dev/null) CMakeLists.txt pyproject.toml constraints.txt
OUT ?= out
# Idle OpenMP threads sleep instead of spinning, which on two cores costs more than the work.
export OMP_WAIT_POLICY ?= passive

.PHONY: demo test test-isa test-slow sanitize lint format bench twin clean
.DEFAULT_GOAL := demo

$(BIN)/python:
	@PYTHON="$(PYTHON)" tools/system-packages.sh run
	"$(PYTHON)" -m venv $(VENV)

$(VENV)/torch.stamp: constraints.txt | $(BIN)/python
	$(PIP) install -q -U "pip>=25.1"
	$(PIP) install -q -c constraints.txt $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) torch
	@touch $@

$(VENV)/package.stamp: $(VENV)/torch.stamp $(SOURCES)
	$(PIP) install -q -c constraints.txt -e .
	@touch $@

$(VENV)/test.stamp: $(VENV)/package.stamp
	@PYTHON="$(PYTHON)" tools/system-packages.sh test
	$(PIP) install -q -c constraints.txt -e ".[trace,sfm,cluster,mesh,video]" --group test --group lint
	@touch $@

demo: $(VENV)/package.stamp
	$(BIN)/rf3dgs demo --out $(OUT)/demo

# Files of tests run side by side, one on each core; four at most, for each takes a few GiB.
test: export OMP_NUM_THREADS ?= 1
test: $(VENV)/test.stamp
	$(BIN)/python -m pytest -m "not slow and not gpu" -n logical --maxprocesses 4 --dist loadfile

# The splatting core's tests with each of its instruction sets; a machine without one runs them with the next narrower.
test-isa: $(VENV)/test.stamp
	for set in portable avx2 avx512; do echo "RF3DGS_ISA=$$set"; \
	  RF3DGS_ISA=$$set $(BIN)/python -m pytest tests/splats -q -m "not slow and not gpu" || exit 1; done

# Hostile scenes under the address, undefined-behaviour and thread sanitizers, with each instruction set.
sanitize: $(VENV)/test.stamp
	PYTHON="$(BIN)/python" OUT="$(OUT)/sanitize" tools/sanitize.sh

test-slow: $(VENV)/test.stamp
	$(BIN)/python -m pytest -m "slow and not gpu"

lint: $(VENV)/test.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

format: $(VENV)/test.stamp
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/test.stamp
	$(BIN)/python -m benchmarks.speed.table --json $(OUT)/bench/table.json
	$(BIN)/python -m benchmarks.speed.scaling --json $(OUT)/bench/scaling.json --figures $(OUT)/bench
	$(BIN)/python -m pytest benchmarks/speed --benchmark-only --benchmark-columns=min,median,rounds

twin: $(VENV)/test.stamp
	$(BIN)/python tools/build_assets.py

clean:
	rm -rf build dist $(VENV) $(OUT)
