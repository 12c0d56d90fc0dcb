# Everything from a fresh machine with make and Python 3.11-3.13: `make test`, `make train`.
# The environment lives in .venv and is installed anew only when pyproject.toml or constraints.txt change.

DELAY    ?= B4_4
NUM_ENVS ?= 2048
ARGS     ?=

# 3.11 first: constraints.txt was made with it. A shim that exists but does not run is passed over.
PYTHON ?= $(firstword $(foreach p,python3.11 python3.12 python3.13 python3,\
            $(if $(shell $(p) -c 'import sys; print((3, 11) <= sys.version_info < (3, 14) or "")' 2>/dev/null | grep True),$(p))))

# A flag with the variable's value, unless ARGS has the flag: the command refuses one given twice.
unless = $(if $(findstring $(1),$(ARGS)),,$(1) $(2))

VENV := .venv
PY   := $(VENV)/bin/python
# No byte-compiling of 2 GB, of which a process imports a fraction: Python does that on import.
PIP  := $(PY) -m pip install --disable-pip-version-check --progress-bar off --no-compile -c constraints.txt

.PHONY: help train bench test test-slow check format docs clean
.DEFAULT_GOAL := help

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*##/\t/' | expand -t 10
	@echo
	@echo "Variables: DELAY=$(DELAY) NUM_ENVS=$(NUM_ENVS) ARGS='more options of the command' PYTHON=$(PYTHON)"
	@echo "GPU: $(PY) -m pip install -c constraints.txt -e '.[cuda]' after the first make"

train: $(VENV)/.run  ## train an agent for DELAY, ending with its table beside baseline and paper
	$(PY) -m mcx_jax.train $(call unless,--delay,$(DELAY)) $(call unless,--num-envs,$(NUM_ENVS)) $(ARGS)

bench: $(VENV)/.run  ## benchmark everything, C MuJoCo and MJX included, on an idle machine
	$(PY) -m mcx_jax.bench $(ARGS)

test: check  ## lint, format, types, then the tests but the slow ones, cheap ones first
	$(PY) -m pytest -m "not slow" -n logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder $(ARGS)

test-slow: $(VENV)/.dev  ## the slow ones: runs killed 24 times, own data and own arm from end to end
	XLA_FLAGS=--xla_backend_optimization_level=2 $(PY) -m pytest -m slow $(ARGS)

check: $(VENV)/.dev  ## lint, format and types only
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pyright --pythonpath $(PY)

format: $(VENV)/.dev  ## apply ruff's automatic fixes
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

docs: $(VENV)/.dev  ## the site, into site/index.html
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --quiet
	@echo "done: site/index.html"

clean:  ## remove caches and build products; keeps .venv and runs/
	rm -rf build dist site .pytest_cache .ruff_cache .hypothesis *.egg-info MUJOCO_LOG.TXT
	find mcx_jax tests tools experiments -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11, 3.12 or 3.13 found; install one or say make PYTHON=/path/to/python3.11"; exit 2; }
	$(PYTHON) -m venv $(VENV)

# pip writes hundreds of lines: they go to a log, which is shown in full if it fails.
$(VENV)/.run: pyproject.toml constraints.txt | $(VENV)/bin/python
	@echo "Installing the pinned packages into $(VENV) (some minutes; log: $(VENV)/install.log)"
	@$(PIP) -e . > $(VENV)/install.log 2>&1 || { cat $(VENV)/install.log; exit 1; }
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	@echo "Installing the pinned packages and test tools into $(VENV) (some minutes; log: $(VENV)/install.log)"
	@$(PIP) -e '.[dev]' > $(VENV)/install.log 2>&1 || { cat $(VENV)/install.log; exit 1; }
	@touch $(VENV)/.run $@
