# tactile-cell: every target sets up what it needs in .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PYTEST_ARGS ?=

.PHONY: run test wheel-test check format bench paper campaign soak vcan clean distclean

run: $(STAMP)  ## teach and identify the paper's five objects on the simulated cell
	$(BIN)/tactile-cell run

test: $(STAMP)  ## all tests, with coverage; those in real time first, while the machine is quiet
	$(BIN)/python -m pytest -m hil --cov --cov-report= $(PYTEST_ARGS)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m "not hil" -n auto --cov --cov-append --cov-report=term \
		--cov-fail-under=90 $(PYTEST_ARGS)

wheel-test: $(STAMP)  ## a project that uses the built wheel runs its tests in a fresh environment
	.ci/wheel-test

check: $(STAMP)  ## lint, format, types, layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)  ## each figure that README and docs quote
	$(BIN)/python -m benchmarks

campaign: $(STAMP)  ## bad input, a million for each parser; every fault; a million random steps: hours. FUZZ_SECONDS=40 for a look
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.fuzz --count 1000000 --seconds $(or $(FUZZ_SECONDS),1e9)
	STATE_STEPS=1000000 STATE_SECONDS=$(or $(FUZZ_SECONDS),1e9) $(BIN)/python -m benchmarks fault_campaign

soak: $(STAMP)  ## 10,000 grasps in virtual time, an hour: memory, files and threads stay flat
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soak --grasps $(or $(GRASPS),10000)

vcan: $(STAMP)  ## the CAN link on a real SocketCAN interface, in a virtual machine (qemu)
	.ci/vcan

paper: $(STAMP)  ## the paper's figures and Table 1 beside ours: out/paper/paper.html
	$(BIN)/python -m benchmarks paper

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "tactile-cell needs Python 3.11 or newer; call make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf out .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis htmlcov
	rm -f .coverage .coverage.*

distclean: clean
	rm -rf $(VENV)
