# `make train` and `make test` need nothing but Python 3.11 or newer and a package index.
# Variables: PYTHON (interpreter that makes the environment), VENV, EXTRAS, TRAIN_ARGS, TEST_ARGS, TEST_WORKERS,
# SOAK_MINUTES.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS_VENV ?= $(VENV)-docs

# The major version of CUDA that the driver offers names the extra: cuda12, cuda13; or nothing.
CUDA ?= $(shell nvidia-smi 2>/dev/null | sed -nE 's/.*CUDA[^:]*Version: *([0-9]+).*/cuda\1/p' | head -n 1)
GPUS := $(shell nvidia-smi -L 2>/dev/null | grep -c '^GPU ')
comma := ,
EXTRAS ?= test,dev$(if $(CUDA),$(comma)warp$(comma)$(CUDA))

# Two GMIs: on two GPUs (virtual ones where there is none), or sharing the only one.
PLAN := $(if $(filter 1,$(GPUS)),plan.gpus=1 plan.gmis_per_gpu=2,plan.gpus=2 plan.gmis_per_gpu=1)
# A million steps: six minutes on two cores, with the making of the environment.
TRAIN_ARGS ?= env=ball_balance $(PLAN) num_timesteps=1000000
TEST_ARGS ?=
# One worker more than cores: those of processes wait for a quarter of their time. The tests of a file share what they
# compile. In order of folders: long ones, of processes, come before the units.
TEST_WORKERS ?= -n $$(($$(nproc) + 1)) --dist loadfile --no-loadscope-reorder
SOAK_MINUTES ?= 60

# Tests start hundreds of processes. Without bytecode each of them compiles what it imports again: seconds.
unexport PYTHONDONTWRITEBYTECODE
export PYTHONPYCACHEPREFIX ?= $(abspath $(VENV))/bytecode

.DEFAULT_GOAL := help
.PHONY: help venv train test test-all soak wheel-test docs docs-pages docs-serve lint types imports format check clean

help:  ## this list
	@sed -nE 's/^([a-z-]+):.*## (.*)/\1|\2/p' Makefile | awk -F'|' '{printf "make %-11s %s\n", $$1, $$2}'

venv: $(READY)  ## the virtual environment with gmijax and its tools, made once

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "PYTHON=$(PYTHON): gmijax needs Python 3.11 or newer" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[$(EXTRAS)]'
	# Its tests run in MJX-JAX, and it asks for warp-lang (149 MB). The extra `test` has the rest.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps 'playground>=0.2,<0.3'
	@touch $@

train: $(READY)  ## a short training run with two GMIs on whatever this machine has
	$(BIN)/python -m gmijax.train $(TRAIN_ARGS)

test: $(READY)  ## the tests that are not slow
	$(BIN)/python -m pytest $(TEST_WORKERS) $(TEST_ARGS)

test-all: $(READY)  ## all tests, slow ones too
	$(BIN)/python -m pytest $(TEST_WORKERS) -m '' $(TEST_ARGS)

soak: $(READY)  ## faults from a fresh seed, all kinds, then a long run's memory; SOAK_MINUTES in all
	$(BIN)/python -m tests.faults.campaign --seed $$(date +%s) --faults 100000 \
	  --minutes $$(($(SOAK_MINUTES) / 2)) --out build/faults.json
	$(BIN)/python -m tests.faults.soak --minutes $$(($(SOAK_MINUTES) / 2))

wheel-test: $(READY)  ## builds the wheel and tries it outside the checkout
	$(BIN)/python -m pytest tests/process/test_wheel.py $(TEST_ARGS)

# An environment of its own: the site needs neither jax nor MuJoCo. Before 25.1 pip knows no groups.
$(DOCS_VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(DOCS_VENV)
	$(DOCS_VENV)/bin/python -m pip install --quiet --disable-pip-version-check 'pip>=25.1'
	$(DOCS_VENV)/bin/python -m pip install --quiet --group docs
	@touch $@

docs-pages: $(DOCS_VENV)/.ready
	$(DOCS_VENV)/bin/python -m docs.pages

docs: docs-pages  ## the documentation as a site in build/docs/site; fails on a dead link
	$(DOCS_VENV)/bin/zensical build --clean --strict --config-file build/docs/zensical.toml

docs-serve: docs-pages  ## the same at http://localhost:8000, built again when a document changes
	$(DOCS_VENV)/bin/zensical serve --config-file build/docs/zensical.toml

lint: $(READY)  ## ruff: rules and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)  ## pyright
	$(BIN)/pyright --pythonpath $(BIN)/python

imports: $(READY)  ## import-linter: who may import whom
	$(BIN)/lint-imports --no-cache --no-logo

format: $(READY)  ## rewrites the sources: order of imports, layout
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

check: lint types imports  ## everything but the tests

clean:  ## removes the environment, caches and build artefacts; keeps runs/
	rm -rf $(VENV) $(DOCS_VENV) .cache build dist .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +
