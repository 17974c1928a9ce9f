# Every target sets itself up: a virtual environment in .venv, the install, then the job.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: help update test test-slow clients tutorials bench docs figures lint format data clean

help:            ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */  make \1\t/'

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $(READY)

update: $(READY) ## update the bridge column on the bundled data (reduced setting); tables and figures into results/
	$(BIN)/python tutorials/02_bridge_column.py --preset reduced --out results

test: $(READY)   ## the quick tests, on all cores
	$(BIN)/python -m pytest -n auto

test-slow: $(READY) ## the slow tests
	$(BIN)/python -m pytest -m slow --timeout 7200

clients:         ## every client on one posterior, against quadrature (two environments of their own, 3 GB)
	PYTHON=$(PYTHON) .ci/clients

tutorials: $(READY) ## every tutorial from top to bottom, with all data
	for t in tutorials/[0-9]*.py; do $(BIN)/python $$t || exit 1; done

bench: $(READY)  ## speed beside the peers, one table
	$(BIN)/python -m tests.benchmarks

docs: $(READY)   ## the pages of docs/ with the API reference, into docs/_build/html; a warning is an error
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	$(BIN)/python -m sphinx -b html -W --keep-going -q docs docs/_build/html

figures: $(READY) ## the pictures of README and docs/, by tutorial 01 and the models themselves
	$(BIN)/python docs/make_figures.py

lint: $(READY)   ## ruff, format and rules
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

format: $(READY) ## let ruff mend what it can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

data: $(READY)   ## make the bundled synthetic data again
	$(BIN)/python data/make_bridge_column_eq1.py
	$(BIN)/python data/make_isolated_bridge.py

clean:           ## remove the environment and the results
	rm -rf $(VENV) .venv-clients .venv-uqpy docs/_build results results-*
