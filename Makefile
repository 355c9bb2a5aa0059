# Everything a developer runs. Needs Python 3.11 or later and make; the rest is set up in .venv at
# first use (from the package index, once) and works offline afterwards.

PYTHON ?= python3
# One more than the two cores of a small machine: a test waits a quarter of its time.
JOBS ?= 3
DOCUMENTS ?= 20000
RECORDS ?= 400
KILLS ?= 40
SEED ?= 1
ONLY ?=
ROOM ?=
# Of `make wheelhouse`; empty: those of this machine.
PLATFORM ?=
TARGET ?=

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet --no-input
# Stamps: what is pinned, and the package itself, each redone when what it is made from changes.
PINNED := $(VENV)/.pinned
READY := $(VENV)/.ready
COMPILED := $(VENV)/.compiled
BENCH := $(VENV)/.bench
DOCS := $(VENV)/.docs
TYPESCRIPT := $(VENV)/typescript/.ready

# Neighbours share what they set up: each process takes a stretch of the list, and none waits.
PARALLEL = -n $(JOBS) --dist worksteal

# Tests of the documentation, and tests that start a browser.
PAGE_TESTS := $(wildcard tests/test_docs*.py) tests/reports/test_html_browser.py \
  $(addprefix tests/application/,test_application_accessibility.py test_application_journey.py \
  test_server_browser.py)

# Without bytecode on disk every process that a test starts compiles 300 modules anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
TSC := $(VENV)/typescript/node_modules/typescript/bin/tsc
# `make lint` checks the types of all modules for Linux, and for the other platforms those of the
# modules that use a name which depends on the platform. Each check has its own cache, because mypy
# discards a cache that was made with other options.
PLATFORMS := linux darwin win32
mypy = $(BIN)/python -m mypy --cache-dir .mypy_cache/$(1) --platform $(1)

CHECKS := check-style $(PLATFORMS:%=types-%) types-benchmarks check-imports check-scripts

.PHONY: check-style check-imports check-scripts ci tests-with-site help setup demo test quick slow lint format bench fuzz docs docs-tests pictures violations \
  coverage alarms coverage-of-tests mutants wheelhouse lock clean

help: ## Show this list
	@sed -n 's/^\([a-z-]*\):.*## /\1|/p' Makefile | awk -F'|' '{ printf "  make %-17s %s\n", $$1, $$2 }'

setup: $(READY) ## Create .venv with the pinned requirements and the package

demo: $(READY) ## Simulate and calibrate the paper's plan: a table and a figure
	$(BIN)/counterspin demo

test: PREPARED = $(COMPILED)
test: lint ## Lint, types, import rules and all tests except slow ones and those of docs-tests
	$(BIN)/python -m pytest $(PARALLEL) -m "not slow" $(PAGE_TESTS:%=--ignore=%)

quick: $(READY) ## Run the fast tests (one minute)
	$(BIN)/python -m pytest $(PARALLEL) --quick 55

slow: $(READY) ## Time each test; list the slow ones, which quick skips, in tests/slow.txt
	$(BIN)/python -m pytest --write-slow

# All tests are collected once, after the site is built. The checks of types run beside them, because
# tests wait a tenth of their time.
ci: $(READY) $(TYPESCRIPT) $(DOCS) ## Run test, docs-tests and the slow tests
	$(MAKE) --no-print-directory -j 2 docs $(COMPILED) $(filter-out types-%,$(CHECKS))
	$(MAKE) --no-print-directory -j 2 tests-with-site $(filter types-%,$(CHECKS))

tests-with-site:
	COUNTERSPIN_SITE=build/site $(BIN)/python -m pytest $(PARALLEL)

lint: $(READY) $(TYPESCRIPT) ## Check lint, format, types and import rules only
	$(MAKE) --no-print-directory -j 2 $(PREPARED) $(CHECKS)

check-style: $(READY)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .

check-imports: $(READY)
	$(BIN)/lint-imports --no-logo

check-scripts:
	@if [ -e $(TYPESCRIPT) ]; then node $(TSC) -p jsconfig.json; fi

# With the package's types from the cache.
types-benchmarks: types-linux
	$(call mypy,linux) $(wildcard benchmarks/*.py)

types-linux: $(READY)
	$(call mypy,linux)

types-%: $(READY)
	$(call mypy,$*) --follow-imports silent $$($(BIN)/python requirements/platform_modules.py)

format: $(READY) ## Format the code and apply the linter's fixes
	$(BIN)/python -m ruff check --fix .
	$(BIN)/python -m ruff format .

bench: $(READY) $(BENCH) ## Time the main jobs; make bench FULL=--full for the sizes of the targets
	$(BIN)/python benchmarks $(FULL) $(if $(KEEP),--keep)

docs: $(READY) $(DOCS) ## Build the documentation in build/site
	@echo "Building the site, which takes a minute."
	@$(BIN)/sphinx-build $(SPHINX) -q -b html -j 8 docs build/site
	@echo "Open build/site/index.html."

docs-tests: docs ## Build the site; test the documentation, and all pages in a browser
	COUNTERSPIN_SITE=build/site $(BIN)/python -m pytest $(PARALLEL) $(PAGE_TESTS)

violations: $(READY) ## Recompute the tables of model violations
	$(BIN)/python docs/violations.py
	$(BIN)/python docs/tumbled.py
	$(BIN)/python docs/incredible.py

fuzz: $(READY) ## Read mutated files of every format, and kill commands that write; docs/harmful-files.md
	$(BIN)/python -m fuzz --documents $(DOCUMENTS) --records $(RECORDS) --kills $(KILLS) \
	  --seed $(SEED) --only "$(ONLY)"

mutants: $(READY) ## Introduce single errors into a copy, and count those that validate detects
	$(BIN)/python -m mutants --tests

alarms: $(READY) ## Recompute the table of false alarms (ten minutes)
	$(BIN)/python docs/false_alarms.py

coverage: $(READY) ## Recompute the tables of interval coverage (half an hour)
	$(BIN)/python docs/coverage.py
	$(BIN)/python docs/varied.py

coverage-of-tests: $(READY) ## Measure branch coverage of the tests; ROOM=physics for one package
	$(BIN)/python -m coverage erase
	$(BIN)/python -m coverage run -m pytest $(PARALLEL) tests/$(ROOM)
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage report $(if $(ROOM),--include "*/counterspin/$(ROOM)/*")

wheelhouse: $(READY) ## Collect all wheels for offline installation: PLATFORM=win_amd64 TARGET=3.12
	$(BIN)/python requirements/wheelhouse.py $(if $(PLATFORM),--platform $(PLATFORM)) \
	  $(if $(TARGET),--python $(TARGET))

pictures: $(READY) ## Regenerate the pictures and examples of the documentation
	$(BIN)/python docs/pictures.py

lock: ## Update the pinned versions: make lock UPGRADE=--upgrade
	@$(require-python)
	$(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip --disable-pip-version-check --quiet install --require-hashes \
	  --requirement requirements/uv.txt
	echo uv | $(compile-pins) - --output-file requirements/uv.txt
	$(compile-pins) pyproject.toml --extra dev --output-file requirements/dev.txt
	$(compile-pins) pyproject.toml --extra bench --constraint requirements/dev.txt \
	  --output-file requirements/bench.txt
	$(compile-pins) pyproject.toml --extra docs --constraint requirements/dev.txt \
	  --output-file requirements/docs.txt
	$(compile-pins) pyproject.toml --extra application --extra cluster --extra excel --extra signature \
	  --extra tdms --constraint requirements/dev.txt --output-file requirements/package.txt

clean: ## Remove .venv, caches and build output
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis \
	  .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Warnings are errors, and so is a reference that leads nowhere. More processes than cores, above:
# each reads some pages in a row, and those of the gallery, which take longest, are neighbours.
SPHINX := -W -n --keep-going -d build/doctrees

# --no-emit-index-url: a pin says which file by its hash, not where somebody fetched it.
# --fork-strategy fewest: one version of each for all Pythons, so that all test the same.
compile-pins = build/lock/bin/uv pip compile --quiet --universal \
  --python-version 3.11 --fork-strategy fewest --generate-hashes --no-emit-index-url \
  --custom-compile-command "make lock" $(UPGRADE)

define require-python
$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
  echo "counterspin needs Python 3.11 or later, and '$(PYTHON)' is not one." >&2; \
  echo "Name one: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
endef

# uv installs the pins in a tenth of the time of pip, which installs them where uv fails. Neither
# compiles: most modules of sympy are never imported.
index-of-pip = $$($(BIN)/python -m pip config list | sed -n "s/^[^=]*[.]index-url='\(.*\)'$$/\1/p" | tail -1)
define install
{ $(PIP) install --no-compile --require-hashes --requirement requirements/uv.txt && \
  UV_DEFAULT_INDEX="$(index-of-pip)" $(BIN)/uv pip install --quiet --python $(BIN)/python \
  --require-hashes --requirement $(1); } 2>/dev/null || \
  $(PIP) install --no-compile --require-hashes --requirement $(1)
endef

$(PINNED): requirements/dev.txt requirements/uv.txt
	@$(require-python)
	@echo "Setting up $(VENV), which takes some seconds the first time."
	@$(PYTHON) -m venv $(VENV) || { \
	  echo "Python could not make a virtual environment (on Debian: apt install python3-venv)." \
	  >&2; exit 1; }
	@$(call install,requirements/dev.txt)
	@touch $@

# The build back end is pinned too, so building needs no isolation and no network.
$(READY): $(PINNED) pyproject.toml src/counterspin/_version.py
	@$(PIP) install --no-deps --no-build-isolation --editable .
	@$(BIN)/python -m compileall -q src
	@touch $@

# One process compiles the imported modules, before several would at the same time.
$(COMPILED): $(READY)
	@$(BIN)/python -m pytest --collect-only -qq >/dev/null 2>&1 || true
	@touch $@

$(BENCH): $(PINNED) requirements/bench.txt
	@$(call install,requirements/bench.txt)
	@touch $@

$(DOCS): $(PINNED) requirements/docs.txt
	@$(call install,requirements/docs.txt)
	@touch $@

# TypeScript, which checks the types of JavaScript, and axe-core, by which tests judge the pages.
# Where there is no node, or no registry that npm reaches, nothing is made, and all goes on without.
$(TYPESCRIPT): requirements/javascript/package-lock.json
	@rm -rf $(@D) && mkdir -p $(@D) && cp requirements/javascript/*.json $(@D)
	@cd $(@D) && { node --version && npm ci --ignore-scripts --no-audit --no-fund \
	  --loglevel error --fetch-retries 0 --fetch-timeout 20000; } >/dev/null && touch $(@F) || \
	  echo "Skipped: the types of JavaScript and axe-core, which could not be set up (node, npm)." >&2
