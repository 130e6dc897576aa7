# Everything a user or a developer runs. A fresh Debian or Ubuntu needs Python >= 3.11
# (with its headers and venv), a C compiler and make; the rest is put into .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet
NATIVE := $(shell find pbonet -name '*.pyx' -o -name '*.pxd' -o -name '*.pxi' -o -name '*.h')

.DEFAULT_GOAL := help
.PHONY: help setup ready installed native page demo hosts-demo check lint mypy pyright test bench docs clean

help:  ## Show this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 14

setup: $(VENV)/.packages  ## Install what is needed to work on pbonet into .venv

$(VENV)/.tools: pyproject.toml
	@$(PYTHON) scripts/preflight.py
	@echo "installing what the demo needs into $(VENV); this takes about a minute, once"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) "setuptools>=77" "Cython>=3.1"
	@touch $@

# What the demo needs.
$(VENV)/.demo: $(VENV)/.tools
	@$(BIN)/python scripts/requirements.py robot plot > $@.txt
	$(PIP) --requirement $@.txt
	@touch $@

# pbonet itself, with the native parts built where they stand.
$(VENV)/.native: $(VENV)/.tools $(NATIVE) setup.py
	$(PIP) --no-build-isolation --no-deps --editable .
	@touch $@

# The one is downloaded and unpacked while the other compiles.
ready: $(VENV)/.tools
	@$(MAKE) --no-print-directory --jobs=2 installed

installed: $(VENV)/.demo $(VENV)/.native
	@:

# What checks, tests and documentation need beside it.
$(VENV)/.packages: $(VENV)/.tools | ready
	@echo "installing what checks and tests need into $(VENV)"
	$(PIP) "pip>=25.1"
	$(PIP) \
	  --group test --group dev --group typing --group docs --group deploy \
	  "pbonet[robot,placo,mujoco,design,plan,mpc,trajectory,devices,plot,parquet,pandas,view,web,ros2,keys,files,metrics,otel,mavlink,can,i2c,gpio,spi,ethercat,deploy]"
	@touch $@

native: $(VENV)/.native  ## Build the native parts again after a change

# The page in the browser. Without npm there is none, and all else works.
PAGE := pbonet/master/web/dist/index.html
$(PAGE): web/package-lock.json web/package.json web/build.mjs $(shell find web/src -type f)
	@command -v npm >/dev/null || { echo "npm is not installed, so the page of pbonet web is not built"; exit 1; }
	cd web && npm ci --no-audit --no-fund && npm run build

page: $(PAGE)  ## Build the page of pbonet web (needs npm)

demo: ready  ## Run the PUMA 560 example for 15 s and plot it
	$(BIN)/python examples/puma/demo.py

hosts-demo: ready  ## Two subsystems on hosts of their own, and a cable that is pulled (root)
	$(BIN)/python examples/two_hosts/demo.py

check: setup  ## Lint, types, layers
	@$(MAKE) --no-print-directory --jobs=2 --output-sync lint mypy pyright

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --config scripts/rooms.toml
	@test ! -x web/node_modules/.bin/prettier || npm --prefix web run --silent format:check

mypy: setup
	$(BIN)/mypy

pyright: setup
	$(BIN)/pyright

# The tests start thousands of processes that import pbonet. What is compiled here they
# need not compile, also where PYTHONDONTWRITEBYTECODE forbids them to keep it.
test: setup  ## Run every test
	-@$(BIN)/python -m compileall -q pbonet
	@$(BIN)/python scripts/run_tests.py

bench: setup  ## Measure all that docs/benchmarks publishes (BENCH=--quick: as little as works)
	$(BIN)/python -m benchmarks.run $(BENCH)

docs: setup  ## Build the documentation
	$(BIN)/sphinx-build --fail-on-warning --keep-going -q -b html docs docs/_build/html

clean:  ## Remove what was built
	rm -rf build docs/_build pbonet.egg-info
	find pbonet \( -name '*.so' -o -name '*.c' \) -delete
	rm -f $(VENV)/.tools $(VENV)/.demo $(VENV)/.native $(VENV)/.packages
