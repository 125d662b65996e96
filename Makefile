# Everything here works from a fresh clone with Python 3.11 and make.
#   make demo     process a sample capture and say where to look
#   make test     all tests: the fast ones first, then the scenarios
#   make bench    quality and speed tables; ARGS="--only speed --quick" for a part of them
#   make lint     ruff and mypy
#   make sample   write sample_data/ and the README's pictures anew

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.PHONY: demo test bench lint sample clean

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
JOBS   ?= 2

demo: $(READY)
	@for capture in sample_data/*/; do \
		$(BIN)/virest process "$$capture" --out demo-out --overwrite; \
	done
	@echo
	@echo "Look at demo-out/<capture>/frames/ beside sample_data/<capture>/movie.mp4;"
	@echo "demo-out/<capture>/parameters.jsonl has one line a frame, run.json the account of the run."

test: $(READY)
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS)

bench: $(READY)
	$(BIN)/python -m virest.app.bench $(ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy virest

sample: $(READY)
	$(BIN)/python -m virest.app.sample sample_data --picture docs/before_after.png
	$(BIN)/virest simulate demo-out/bracket --auto-exposure 5:9 --rate 0 --exposure-ms 4 --frames 27 \
		--width 640 --height 480 --response five_segment --overwrite --quiet
	$(BIN)/virest calibrate-curve demo-out/bracket --out demo-out/curve.yaml --plot docs/curve.png --overwrite
	rm -rf demo-out/bracket demo-out/curve.yaml

clean:
	rm -rf demo-out bench-out virest-out build dist .pytest_cache .mypy_cache .ruff_cache

$(READY): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: no python3.11 and no python3 found" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "make: $(PYTHON) is older than Python 3.11; set PYTHON=..." >&2; exit 1; }
	test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $(READY)
