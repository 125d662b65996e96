# Everything here works from a fresh clone with Python 3.11 and make.
#   make demo     restore the sample captures and end with the path of a report
#   make test     all tests: the fast ones first, then the scenarios
#   make bench    quality and speed tables; ARGS="--only speed --quick" for a part of them
#   make lint     ruff and mypy
#   make readme   run what README and docs show and write its output into them; ARGS="--list" lists the blocks
#   make docs     the documentation as a site in site/, with the manual page virest.1; make figures draws its pictures anew
#   make mutants  small faults in the code that no fast test notices; ARGS="--rooms diagnosis --count 20"
#   make sample   write sample_data/ anew

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.PHONY: demo test bench lint readme docs figures mutants sample clean

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
INSTALLED := $(VENV)/.installed
JOBS   ?= 2

demo: $(INSTALLED)
	@for capture in sample_data/*/; do \
		$(BIN)/virest process "$$capture" --out demo-out --overwrite; \
	done
	@$(BIN)/virest report demo-out --capture sample_data --overwrite --quiet > /dev/null
	@echo
	@echo "Open this in a browser: $(CURDIR)/demo-out/report.html"

test: $(READY)
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist loadgroup --no-loadscope-reorder \
		--max-worker-restart 0

bench: $(READY)
	$(BIN)/python -m virest.app.bench $(ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy virest

readme: $(READY)
	$(BIN)/python -m virest.app.pages $(ARGS)

docs: $(READY)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	$(BIN)/virest --man > site/virest.1

figures: $(READY)
	$(BIN)/python -m virest.app.pictures docs/images
	$(BIN)/python -m virest.app.gallery docs
	$(BIN)/virest simulate demo-out/bracket --auto-exposure 5:9 --rate 0 --exposure-ms 4 --frames 27 \
		--width 640 --height 480 --response five_segment --overwrite --quiet
	$(BIN)/virest calibrate-curve demo-out/bracket --out demo-out/curve.yaml --plot docs/images/curve.png --overwrite
	rm -rf demo-out/bracket demo-out/curve.yaml

mutants: $(READY)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[mutation]'
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/python tests/mutants.py $(ARGS)

sample: $(READY)
	$(BIN)/python -m virest.app.sample sample_data

clean:
	rm -rf demo-out bench-out virest-out site build dist .pytest_cache .mypy_cache .ruff_cache

$(READY): $(INSTALLED)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $(READY)

$(INSTALLED): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: no python3.11 and no python3 found" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "make: $(PYTHON) is older than Python 3.11; set PYTHON=..." >&2; exit 1; }
	test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	@touch $(INSTALLED)
