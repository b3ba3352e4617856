# Two commands do everything on a machine that has python3 (3.11 or later), pip, make and git:
#   make demo    install, run the whole chain on shipped data, print the report's path
#   make test    install, then every check that a change must pass

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
JOBS   ?= 2

INSTALL := $(BIN)/uv pip install --quiet --python

.DEFAULT_GOAL := help
.PHONY: help install demo test checks lint types rooms kernels unit lowest test-lowest examples docs bench \
	validation fuzz nuts mutants dist lock clean

# What Python compiles of a module that is used is kept for the hundreds of processes of the tests.
unexport PYTHONDONTWRITEBYTECODE

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

# The stamp is newer than what it was made from, so a second call installs nothing.
$(VENV)/.installed: pyproject.toml requirements/dev.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint requirements/dev.txt uv
	$(INSTALL) $(BIN)/python --requirements requirements/dev.txt
	$(INSTALL) $(BIN)/python --no-deps --editable .
	touch $@

install: $(VENV)/.installed  ## the pinned environment in .venv

demo: install  ## the whole chain on shipped data
	$(BIN)/dahl-ident demo --overwrite

# The kernels are compiled once, in parallel with the checks, and not by every process of pytest.
test: install  ## every check that a change must pass
	$(MAKE) --jobs $(JOBS) --output-sync checks
	$(MAKE) unit

checks: types kernels lint rooms

lint: install  ## ruff, check and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install  ## mypy, strict
	$(BIN)/mypy

rooms: install  ## the order of the rooms
	$(BIN)/lint-imports

COMPILED := from dahl_ident.engine.motion import kernels; list(map(kernels, ("cycle", "samples", "loop")))

kernels: install  ## the engine, compiled if it is not
	$(BIN)/python -c '$(COMPILED)'

unit: install  ## tests and doctests, warnings as errors
	$(BIN)/pytest -n $(JOBS) --dist worksteal

# The lowest declared versions, with the kernels compiled on them.
.venv-lowest/.installed: $(VENV)/.installed
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python .venv-lowest
	$(INSTALL) .venv-lowest/bin/python --resolution lowest-direct --editable ".[dev]"
	.venv-lowest/bin/python -c '$(COMPILED)'
	touch $@

lowest: .venv-lowest/.installed

test-lowest: lowest  ## the tests marked as dependent on versions, on the lowest declared ones
	.venv-lowest/bin/pytest -n $(JOBS) --dist worksteal -m "versions and not long" tests

examples: install  ## renew the outputs in README, manual and notebooks
	$(BIN)/python -m tests.examples

docs: install  ## the manual with its examples and notebooks run; any warning fails
	$(BIN)/pytest -q -n $(JOBS) --dist worksteal -m manual tests/test_docs.py
	$(BIN)/python -m sphinx -q -W --keep-going -b html -j $(JOBS) docs docs/_build/html

bench: install  ## timings side by side with the peers, written into the manual
	$(BIN)/python -m benchmarks --write docs/benchmarks.md

# Stated errors against records and tables whose truth is known; each page says what was met.
validation: install  ## long statistical checks, written into docs/validation
	$(BIN)/pytest -q -n $(JOBS) --dist worksteal -m long tests
	$(BIN)/python -m benchmarks.extraction_validation --write docs/validation/extraction.md
	$(BIN)/python -m benchmarks.calibration
	$(BIN)/python -m benchmarks.coverage
	$(BIN)/python -m benchmarks.campaigns
	$(BIN)/python -m benchmarks.uncertainty --write docs/validation/uncertainty.md
	$(BIN)/python -m benchmarks.posteriors --write docs/validation/posteriors.md
	$(BIN)/python -m benchmarks.planning --write docs/validation/planning.md
	$(BIN)/python -m benchmarks.laws --write docs/validation/laws.md
	$(BIN)/python -m benchmarks.engine_oracles --write docs/validation/engine.md
	$(BIN)/python -m benchmarks.driven_plants
	$(BIN)/python -m benchmarks.cold_records --write docs/validation/cold_records.md

fuzz: install  ## thousands of damaged files of every format, and the table of what became of them
	$(BIN)/python -m tests.reader_fuzz

nuts: install  ## an independent sampler on the same posterior, in an environment of its own
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python .venv-nuts
	$(INSTALL) .venv-nuts/bin/python --editable ".[nuts,peers]"
	.venv-nuts/bin/python -m benchmarks.nuts

mutants: install  ## a sample of small changes that the tests should notice: which survive (hours)
	$(BIN)/python -m benchmarks.mutants --sample 150 --seed 1

# What users would install: built, checked, installed alone, and the demonstration run from it.
dist: install  ## wheel and source archive in dist/, tried in an empty environment
	rm -rf dist .venv-dist
	$(BIN)/uv build --quiet --out-dir dist
	$(BIN)/uvx --quiet twine check --strict dist/*
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python .venv-dist
	$(INSTALL) .venv-dist/bin/python dist/*.whl
	empty=$$(mktemp -d) && cd $$empty && $(CURDIR)/.venv-dist/bin/dahl-ident demo && rm -rf $$empty

lock: install  ## renew the pinned environment from pyproject.toml
	$(BIN)/uv pip compile --quiet --no-emit-index-url --no-emit-find-links --upgrade \
		--python-version 3.11 --universal --extra dev --output-file requirements/dev.txt \
		--custom-compile-command "make lock" pyproject.toml

clean:  ## remove what the commands above made
	rm -rf $(VENV) .venv-lowest .venv-nuts .venv-dist build dist docs/_build out .pytest_cache .mypy_cache .ruff_cache
