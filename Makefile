# make demo    set everything up and run the demo (FAULT=c_by, or none; ONCE=1 SEED=7 PACE=20)
# make test    set everything up and run all checks
# make quick   tests of the models and the monitor alone, a minute
# make long    the tests of `make test` on further machines, seeds and realisations
# make format  let ruff put the code in order
# make wheels  build both wheels into dist/, and run the demo out of the wheel under every Python there is here
# make floors  run the demo and the tests below with the lowest versions that pyproject.toml admits

# Asked, since a shim may stand where no version is installed.
PYTHONS := $(foreach minor,11 12 13,$(shell python3.$(minor) -c 'print("python3.$(minor)")' 2>/dev/null))
PYTHON ?= $(or $(firstword $(PYTHONS)),python3.11)
VENV := .venv
BIN := $(VENV)/bin
RUN := $(VENV)/.run
READY := $(VENV)/.ready
# Modules are compiled when first imported; of most of what is installed, nothing ever is.
INSTALL := $(BIN)/python -m pip install --no-compile --quiet --disable-pip-version-check --constraint constraints.txt --editable
MODELS_AND_MONITOR := tests/test_doctests.py tests/physics tests/signals tests/diagnosis tests/commissioning $(wildcard tests/service/monitor/test_monitor*.py)
# One more than a small computer has cores, as some tests only wait; those that compute slow one another down. On two
# cores, all tests took 920 s with three workers and 1001 s with six, in clean clones; those of commissioning and of
# baselines alone 112 and 130 s, with two workers 97 s.
WORKERS ?= 3
FAULT ?= k_by
SEED ?= 1
PACE ?= 10
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
# What programs free stays theirs: large arrays handed back to the kernel, and asked for anew, cost tests a tenth.
export MALLOC_MMAP_THRESHOLD_ := 33554432
export MALLOC_TRIM_THRESHOLD_ := 268435456
# Tests start many programs; what they import is compiled once.
unexport PYTHONDONTWRITEBYTECODE

BROWSERS := chromium-headless-shell chromium chromium-browser google-chrome google-chrome-stable chrome

.PHONY: setup demo test quick long lint types contracts browser tests format wheels floors train clean

setup: $(READY)

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "rotorwatch needs Python 3.11, 3.12 or 3.13 (none found; say make PYTHON=...)"; exit 1; }
	@$(PYTHON) -m venv $(VENV)

# What runs needs no torch; training and the checks do.
$(RUN): pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing what rotorwatch needs (a minute the first time) ..."
	@$(INSTALL) .
	@touch $@

$(READY): pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing what rotorwatch, training and the checks need (two minutes the first time) ..."
	@$(INSTALL) '.[train,dev,io,postgres,fleet]'
	@touch $(RUN) $@

demo: $(RUN)
	@$(BIN)/rotorwatch demo --fault $(FAULT) --seed $(SEED) --pace $(PACE) $(if $(ONCE),--once)

# Side by side: the tests, which take longest, begin first, and Chromium is installed while pip is at work.
test:
	@$(MAKE) --no-print-directory --jobs=5 tests lint types contracts

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy
	$(BIN)/mypy benchmarks/*.py  # programs, which find each other in their own folder

contracts: $(READY)
	$(BIN)/lint-imports

# The tests of the page need a real one; Debian's is installed where it may be. Without windows of its own, it computes a
# seventh less.
browser:
	@for one in "$$ROTORWATCH_CHROMIUM" $(BROWSERS); do command -v "$$one" >/dev/null && exit 0; done; \
	if test "$$(id -u)" = 0 && command -v apt-get >/dev/null; then \
		echo "installing Chromium, for the tests of the page ..."; \
		timeout 60 apt-get update >/dev/null 2>&1; \
		for one in chromium-headless-shell chromium; do \
			timeout 300 apt-get install --yes --no-install-recommends $$one >/dev/null 2>&1 && exit 0; \
		done; \
	fi; \
	echo "NO BROWSER: tests/service/api/page/test_browser*.py are left out; install Chromium, or name one in ROTORWATCH_CHROMIUM"

tests: $(READY) browser
	$(BIN)/pytest -n $(WORKERS)

# These compute more than they wait.
quick: $(READY)
	$(BIN)/pytest -n logical -m "not slow and not long" $(MODELS_AND_MONITOR)

long: $(READY)
	$(BIN)/pytest -n $(WORKERS) -m long

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# From a copy: setuptools builds in the tree, and would pack what is left there of older trees.
wheels:
	@rm -rf dist build && mkdir -p build/source && cp -r pyproject.toml README.md LICENSE models rotorwatch service simulator build/source
	@set -e; for python in $(PYTHONS); do \
	  rm -rf build/venv && $$python -m venv build/venv; \
	  test -d dist || build/venv/bin/python -m pip wheel --quiet --no-deps --wheel-dir dist build/source build/source/rotorwatch; \
	  build/venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt dist/rotorwatch-*.whl; \
	  (cd build && venv/bin/python --version && venv/bin/rotorwatch demo --once); \
	done

FLOORS := $(CURDIR)/build/floors
FLOOR_TESTS := tests/signals/test_recording.py tests/interchange/test_formats.py $(foreach name,access_http api api_events client metrics \
  plots replay_http rotorwatch_cli snapshots store transport webhooks,$(wildcard tests/service/*/test_$(name).py))

floors:
	@rm -rf $(FLOORS) && $(PYTHON) -m venv $(FLOORS)
	@$(FLOORS)/bin/python -m pip install --quiet --disable-pip-version-check 'uv>=0.9'
	@$(FLOORS)/bin/uv pip compile --quiet --python $(FLOORS)/bin/python --resolution lowest-direct --output-file $(FLOORS)/floors.txt \
	  $(patsubst %,--extra %,plots io postgres dev) pyproject.toml
	@$(FLOORS)/bin/uv pip install --quiet --python $(FLOORS)/bin/python --requirement $(FLOORS)/floors.txt
	@$(FLOORS)/bin/uv pip install --quiet --python $(FLOORS)/bin/python --no-deps --editable .
	$(FLOORS)/bin/rotorwatch demo --once --pace 20
	PATH=$(FLOORS)/bin:$$PATH $(FLOORS)/bin/pytest -n0 -W default $(FLOOR_TESTS)  # old libraries use what is deprecated now

train: $(READY)
	$(BIN)/rotortrain train --machine lab --out models/bundles/lab

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis
