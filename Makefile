# Three commands; each sets up what it needs in .venv/ (pinned packages) and writes its results to out/.
SHELL := /bin/sh
BIN := .venv/bin

.PHONY: help demo test bench lint setup clean

help:
	@echo "make demo   the main job on a real brain, end to end (results in out/demo/)"
	@echo "make test   lint, types, unit and integration tests"
	@echo "make bench  speed beside accuracy (results in out/bench/)"
	@echo "make clean  remove out/ and build leftovers (keeps .venv/)"

setup:
	@command -v python3 >/dev/null || { echo "python3 is missing: apt-get install python3 python3-venv python3-pip" >&2; exit 1; }
	@python3 scripts/bootstrap.py

demo: setup
	@$(BIN)/brainshift demo --output out/demo

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# What starts no graph of nodes is shared by two processes, a file at a time, with one thread each; graphs need the machine.
test: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow and not integration" -n 2 --dist loadfile
	$(BIN)/python -m pytest -m "integration and not slow"

bench: setup
	@python3 scripts/bootstrap.py --peers
	$(BIN)/python -m bench --output out/bench

clean:
	rm -rf out build install log brainshift_ros.egg-info
