# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
#
# A virtual environment in .venv, made when first needed. With ROS 2 Jazzy sourced it uses that
# rclpy; otherwise it installs rclpy's wheels from PyPI. PYTHON=… chooses the interpreter.

VENV := .venv
BIN := $(VENV)/bin
# Not compiled at once, which would take a third of the time and of the room.
PIP := $(BIN)/python -m pip install --disable-pip-version-check --no-compile
SOURCES := setup.py setup.cfg pyproject.toml package.xml \
  $(wildcard config/*.yaml examples/*.py tsobs_ros/core/*.[ch])
# What the demo needs, and everything that the README shows; tests need more.
DEMO_EXTRAS ?= report,watch
EXTRAS := design,report,export,campaign,watch
# The NumPy that a ROS found was built for; another one breaks its messages.
NUMPY = $$(test -s $(VENV)/.ros || $(BIN)/python -c 'import numpy; print("numpy==" + numpy.__version__)')
# Each process imports everything: more of them than cores cost more than they gain.
PYTEST_ARGS ?= -n auto --maxprocesses 4 --dist loadgroup
# Else threads of the linear algebra wait actively for cores that other tests use.
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/pytest $(PYTEST_ARGS)
# Python keeps what it compiles, also in a container that asks for the opposite: tests and nodes are
# hundreds of processes.
unexport PYTHONDONTWRITEBYTECODE
CHECKS := undefined,float-cast-overflow
SANITIZE := -fsanitize=address,$(CHECKS) -fno-sanitize-recover=$(CHECKS) -O1 -g \
  -fno-omit-frame-pointer
SANITIZE_TESTS ?= test/estimation test/model test/simulation

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.PHONY: help demo test quick-tests test-all all-tests sanitize fuzz lint format docs links figures clean
.DEFAULT_GOAL := help

# A version manager's shim may exist and yet fail, so every candidate is run.
define find_python
candidates="$(if $(PYTHON),"$(PYTHON)",python3.12 python3.11 python3.13 python3)"; \
for candidate in $$candidates; do \
  if "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2> /dev/null; then \
    python="$$candidate"; break; \
  fi; \
done; \
if [ -z "$${python:-}" ]; then \
  echo "error: no Python 3.11 or later among $$candidates; set PYTHON=/path/to/python3" >&2; \
  exit 1; \
fi
endef

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 16

demo: $(VENV)/.demo ## Simulate the arm, observe it, record, and report (DEMO_ARGS=…)
	@$(BIN)/tsobs demo $(DEMO_ARGS)
	@echo "the tsobs command is in $(BIN): source $(BIN)/activate" >&2
	@echo "Designs, Parquet files and campaigns take more: pip install -e" \
	  "'.[design,export,campaign]'" >&2

# The checks run beside the tests.
test: $(VENV)/.test ## Lint, check types and run the tests, but for those marked slow (PYTEST_ARGS=…)
	@$(MAKE) --no-print-directory --jobs=2 lint quick-tests

test-all: $(VENV)/.test ## Lint, check types and run all tests
	@$(MAKE) --no-print-directory --jobs=2 lint all-tests

quick-tests: $(VENV)/.test
	$(PYTEST) -m "not slow"

all-tests: $(VENV)/.test
	$(PYTEST)

# The sanitizer has to be in the process before Python: a core linked with it cannot be loaded
# otherwise. Memory that Python hands out itself would hide accesses out of bounds. Its reports go
# around what pytest captures, as they are a process's last words.
define with_sanitizers
mkdir -p build/sanitize; \
for name in libclang_rt.asan-$$(uname -m).so libclang_rt.asan.so libasan.so; do \
  runtime="$$($(CC) -print-file-name=$$name)"; \
  if [ -f "$$runtime" ]; then break; fi; \
done; \
build=($(CC) -std=c99 -ffp-contract=off -fno-math-errno -fvisibility=hidden $(SANITIZE) \
  -fPIC -shared); \
if [ ! -f "$$runtime" ] \
  || ! echo 'int probe;' | "$${build[@]}" -x c - -o build/sanitize/probe.so 2> /dev/null; then \
  echo "skipped: $(CC) has no address and undefined-behaviour sanitizers" >&2; \
  exit 0; \
fi; \
include="$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("include"))')"; \
"$${build[@]}" -DPy_LIMITED_API=0x030B0000 -I"$$include" tsobs_ros/core/*.c -lm \
  -o build/sanitize/native.so; \
TSOBS_NATIVE=build/sanitize/native.so PYTHONPATH=.:test/core LD_PRELOAD="$$runtime" \
  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 PYTHONMALLOC=malloc
endef

sanitize: $(VENV)/.test ## Test the compiled core with sanitizers (CC=…, SANITIZE_TESTS=…)
	@$(with_sanitizers) $(BIN)/pytest --capture=sys -p other_build $(SANITIZE_TESTS)

fuzz: $(VENV)/.test ## Feed the compiled core hostile inputs, with sanitizers (CC=…, FUZZ_ARGS=…)
	@$(with_sanitizers) $(BIN)/python benchmarks/fuzz_core.py \
	  --note build/sanitize/input $(FUZZ_ARGS)

lint: $(VENV)/.test ## Only lint and check types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.test ## Format the sources
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.test ## Build the site into build/site; a warning is an error
	$(BIN)/sphinx-build -W --keep-going -q -d build/doctrees docs build/site
	@echo "open build/site/index.html"

links: $(VENV)/.test ## Try the links to other sites
	$(BIN)/sphinx-build -q -b linkcheck -d build/doctrees docs build/links

figures: $(VENV)/.test ## Make the figures of the site again
	$(BIN)/python docs/figures.py

clean: ## Remove the virtual environment and everything built
	rm -rf $(VENV) build install log dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	rm -f tsobs_ros/core/*.so
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.demo: $(SOURCES) | $(BIN)/python
	@echo "Installing tsobs_ros into $(VENV) (once)"
	@$(PIP) $(NUMPY) -e ".[$$(cat $(VENV)/.ros)$(DEMO_EXTRAS)]"
	@touch $@

$(VENV)/.test: $(SOURCES) | $(BIN)/python
	@echo "Installing tsobs_ros and its test tools into $(VENV) (once)"
	@$(PIP) $(NUMPY) -e ".[$$(cat $(VENV)/.ros)$(EXTRAS),docs,test]"
	@touch $@ $(VENV)/.demo

# A ROS counts as found only if the new environment sees it too, which it does not if $$python is
# itself in a virtual environment.
$(BIN)/python:
	@$(find_python); \
	version="$$("$$python" -V)"; \
	if "$$python" -c 'import rclpy' 2> /dev/null \
	  && "$$python" -m venv --clear --system-site-packages $(VENV) \
	  && $(BIN)/python -c 'import rclpy' 2> /dev/null; then \
	  echo "Made $(VENV) with $$version and the ROS found"; \
	  : > $(VENV)/.ros; \
	else \
	  "$$python" -m venv --clear $(VENV); \
	  echo "Made $(VENV) with $$version; ROS will come from PyPI"; \
	  printf 'ros,' > $(VENV)/.ros; \
	fi; \
	$(PIP) --quiet --upgrade pip || true  # Python 3.11 brings one that takes twice the time
