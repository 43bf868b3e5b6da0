# tactile-cell: every target sets up what it needs in .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN := $(VENV)/.run
DEV := $(VENV)/.dev
DOCS := $(VENV)/.docs
INSTALL := $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable
PYTEST_ARGS ?=
# Byte code is kept between runs: to compile all tests again takes seconds.
PYTEST = env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest
TESTS = $(PYTEST) -n auto --dist worksteal $(PYTEST_ARGS)
# Runs of tests that take longer than usual.
UNTIMED = $(TESTS) -p no:processor_time

.PHONY: run serve quick test test-long test-real-time coverage mutants wheel-test check format docs docs-pages pictures bench paper campaign soak vcan clients help clean distclean

run: $(RUN)  ## teach and identify the paper's five objects on the simulated cell
	$(BIN)/tactile-cell run

serve: $(RUN)  ## the simulated cell in real time, with five taught objects; prints the address of its page
	$(BIN)/tactile-cell serve

quick: $(DEV)  ## the tests that take less than 0.3 s each, without whole cells: for the loop while you write
	$(TESTS) -m "not real_time and not long and not slow"

test: $(DEV)  ## the tests of each change: minutes, on any machine
	$(TESTS) -m "not real_time and not long"

test-long: $(DEV)  ## the long tests: each row of the campaign, studies, the paper; PYTEST_ARGS=--days=14 runs the slice of today
	$(TESTS) -m "long and not real_time"

test-real-time: $(DEV)  ## tests that measure times of real processes, one after the other: for a quiet machine
	$(PYTEST) -m "real_time and not long" $(PYTEST_ARGS)

mutants: $(DEV)  ## 60 random changes of the code, and which of them the tests find; N=100 for more, SEED=2 for others
	$(INSTALL) '.[mutants]'
	mkdir -p out
	$(TESTS) -m "not real_time and not long" --processor-times=out/times.txt
	$(BIN)/python -m tests.mutants draw out/mutants.json --n $(or $(N),60) --seed $(or $(SEED),1)
	$(BIN)/python -m tests.mutants run out/mutants.json out/times.txt

coverage: $(DEV)  ## line coverage of the tests without real time: less than 95 % is an error; takes three times as long
	$(UNTIMED) -m "not real_time" --cov --cov-report=term:skip-covered --cov-fail-under=95

wheel-test: $(DEV)  ## the tests of a project that uses the built wheel, in a fresh environment
	.ci/wheel-test

check: $(DEV)  ## lint, format, types, layers, tables of the docs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m docs.tools --check

format: $(DEV)  ## automatic fixes of ruff
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(DOCS)  ## the site in out/docs; a warning or a broken link inside is an error
	$(BIN)/python -m sphinx -q -W --keep-going -E -b html docs out/docs

docs-pages: $(DEV)  ## write the tables that are made from the code into the pages of docs
	$(BIN)/python -m docs.tools

pictures: $(DEV)  ## pictures of the docs and transcripts of the tutorial, from a new run (chromium)
	$(BIN)/python -m docs.tools.pictures

bench: $(DEV)  ## each figure that README and docs quote
	$(BIN)/python -m benchmarks

campaign: $(DEV)  ## every fault, then 2,000 new inputs for each parser and new random tests; ROUNDS=500 for a million inputs
	$(TESTS) -m "not real_time" -o junit_family=xunit1 --junitxml=out/fault-campaign.xml tests/faults/test_fault_rows.py
	$(BIN)/python -m pytest -m real_time tests/faults/test_fault_rows.py tests/hil
	for round in $$(seq $(or $(ROUNDS),1)); do \
	TACTILE_CELL_INPUTS=2000 $(UNTIMED) -m "not real_time" --timeout=3600 tests/fuzz tests/faults/test_state_machine.py || exit; done

soak: $(DEV)  ## 10,000 connections to each interface, a watched shift, 42 starts; hours: memory, files, threads stay flat
	for work in "--connects $(or $(CONNECTS),10000)" "--hours $(or $(HOURS),8)" "--starts $(or $(STARTS),42)"; do \
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.performance.soak $$work || exit; done

vcan: $(DEV)  ## the CAN link on a real SocketCAN interface, in a virtual machine (qemu)
	.ci/vcan

clients: $(DEV)  ## independent clients in JavaScript and C command the cell through each interface; installs them with npm
	.ci/clients

paper: $(DEV)  ## the paper's claims about grasps, with our figures and a verdict
	$(BIN)/python -m benchmarks reproduction

$(RUN): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "tactile-cell needs Python 3.11 or newer; call make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) '.[report,serve]'
	touch $@

$(DEV): $(RUN)  # the packages for tests, checks and benchmarks
	$(INSTALL) '.[dev]'
	touch $@

$(DOCS): $(DEV)
	$(INSTALL) '.[docs]'
	touch $@

help:  ## this list
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/\1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{ printf "  make %-15s %s\n", $$1, $$2 }'

clean:  ## remove the output of runs, tests and tools
	rm -rf out .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis htmlcov
	rm -f .coverage .coverage.*

distclean: clean  ## clean, and remove .venv
	rm -rf $(VENV)
