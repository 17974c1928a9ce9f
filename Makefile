# Each target makes the virtual environment .venv and installs the project first if needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NEWER_PYTHON ?= python3.13
READY := $(VENV)/.ready

# tests start hundreds of interpreters, and pytest rewrites 200 files: bytecode is kept whatever the machine's setting
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help update size test test-newer test-slow clients tutorials bench docs figures lint format data clean

help:            ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */  make \1\t/'

$(READY): pyproject.toml .ci/setup
	.ci/setup
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $(READY)

update: $(READY) ## update the bridge column on bundled data; writes report.html and tables to results/
	$(BIN)/fe-likelihoods run data/templates/column.toml --out results

test: $(READY)   ## run the quick tests on all cores
	$(BIN)/python -m tests.compile_kernels
	$(BIN)/python -m pytest -p no:randomly -n auto --dist worksteal

.venv-newer/.ready: pyproject.toml
	$(NEWER_PYTHON) -m venv .venv-newer
	.venv-newer/bin/python -m pip install --quiet --disable-pip-version-check --editable . pytest pytest-timeout
	@touch $@

test-newer: .venv-newer/.ready ## tests that use arviz, with arviz 1 and NEWER_PYTHON (from 3.12 on)
	.venv-newer/bin/python -m pytest tests/reporting/test_arviz_data.py

# `PYTEST_ADDOPTS=--randomly-seed=n make test-slow` repeats an order: the first lines of the output name the seed
test-slow: $(READY) ## run the slow tests on all cores, in random order
	$(BIN)/python -m tests.compile_kernels
	$(BIN)/python -m pytest -m slow -n auto --dist worksteal --timeout 3600 --randomly-dont-reset-seed

clients:         ## run every client on one posterior and compare with quadrature (makes an environment)
	PYTHON=$(PYTHON) .ci/clients

tutorials: $(READY) ## run every tutorial; figures go to results-tutorials/
	mkdir -p results-tutorials
	cd results-tutorials && for t in ../tutorials/[0-9]*.py; do MPLBACKEND=Agg ../$(BIN)/python $$t || exit 1; done

bench: $(READY)  ## run all benchmarks: accuracy and speed, many hours; `python -m benchmarks NAME` runs one
	$(BIN)/python -m benchmarks

size: $(READY)   ## print the size of the project: lines, names, settings, frames, prose
	$(BIN)/python -m tests.size

docs: $(READY)   ## build the documentation into docs/_build/html; warnings are errors
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	$(BIN)/python -m sphinx -b html -W --keep-going -q docs docs/_build/html

figures: $(READY) ## make the figures of README and docs again
	$(BIN)/python docs/make_figures.py

lint: $(READY)   ## check format and rules with ruff, and how docstrings read
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/python -m tests.prose
	! grep -rnE '^(<<<<<<<|>>>>>>>) ' docs tutorials README.md CHANGELOG.md CONTRIBUTING.md

format: $(READY) ## format and fix with ruff
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

data: $(READY)   ## make the bundled synthetic data again
	$(BIN)/python data/make_bridge_column_eq1.py
	$(BIN)/python data/make_bridge_column_events.py
	$(BIN)/python data/make_bridge_column_short.py
	$(BIN)/python data/make_isolated_bridge.py

clean:           ## remove the environments, the built documentation and the results
	rm -rf $(VENV) .venv-newer .venv-clients docs/_build results results-*
