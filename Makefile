# make demo    set everything up and run the demo (FAULT=c_by ONCE=1 SEED=7 PACE=20)
# make test    set everything up and run all checks
# make format  let ruff put the code in order

PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
RUN := $(VENV)/.run
READY := $(VENV)/.ready
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable
FAULT ?= k_by
SEED ?= 1
PACE ?= 10
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1

.PHONY: setup demo test lint types contracts tests format train clean

setup: $(READY)

# What runs needs no torch; training and the checks do.
$(RUN): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "rotorwatch needs Python 3.11 ($(PYTHON) not found; say make PYTHON=...)"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing what rotorwatch needs (a minute the first time) ..."
	@$(INSTALL) .
	@touch $@

$(READY): $(RUN)
	@echo "installing what training and the checks need ..."
	@$(INSTALL) '.[train,dev,peers,io,postgres]'
	@touch $@

demo: $(RUN)
	@$(BIN)/rotorwatch demo --fault $(FAULT) --seed $(SEED) --pace $(PACE) $(if $(ONCE),--once)

test: lint types contracts tests

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

contracts: $(READY)
	$(BIN)/lint-imports

# Two at a time; tests that open ports and start programs stay together in one of the two (tests/conftest.py).
tests: $(READY)
	$(BIN)/pytest -n 2

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

train: $(READY)
	$(BIN)/rotortrain train --machine lab --out models/bundles/lab

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis
