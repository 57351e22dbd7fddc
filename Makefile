# Every target works from a fresh clone with Python >= 3.10 and make: what it needs is installed into .venv first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
EXTRAS := learn,torchrl,rsl-rl,pettingzoo,imitation,sweep,wandb,logs,vision,render,view,mujoco,mpc,perception,hardware,ros2,xacro,dev
STRICT := $(wildcard $(addprefix src/finssim/,core physics control localization)) studies
# Named by content and extras, so that a fresh checkout or another branch with the same requirements installs nothing again.
STAMP := $(VENV)/.installed-$(shell { echo $(EXTRAS); cat pyproject.toml constraints.txt; } | cksum | cut -d " " -f 1)

# `make demo` needs the package without its extras; where everything is installed already, that will do.
LIGHT := $(if $(wildcard $(STAMP)),$(STAMP),$(VENV)/.light-$(shell cat pyproject.toml constraints.txt | cksum | cut -d " " -f 1))

# Compiled modules are kept, also where the shell forbids it: hundreds of processes import the same ones.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test quick core check format bench docs clean

help:  ## list the targets
	@sed -n 's/^\([a-z]*\):.*##/make \1\t/p' Makefile | expand -t 16

demo: $(LIGHT)  ## identify, train, evaluate and report: the whole loop, result in demo/
	$(BIN)/finssim demo

# Some tests start processes that keep an appointment with the clock, which a busy machine can miss: what failed runs
# once more, alone, and what fails twice fails. A third process has work while two wait for such appointments.
test: check  ## check, then run every test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder --durations 25 || { [ $$? = 1 ] && \
		OMP_NUM_THREADS=1 $(BIN)/python -m pytest --last-failed --last-failed-no-failures none; }

quick: $(STAMP)  ## the tests that take little time and start no process
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow" -q

core: $(STAMP)  ## the quick tests of the core, in a copy without the extensions
	rm -rf build/core && mkdir -p build/core
	cp -r src tests examples docs studies benchmarks tools pyproject.toml build/core
	rm -r build/core/src/finssim/extensions build/core/tests/extensions
	cd build/core && PYTHONPATH=$(CURDIR)/build/core/src OMP_NUM_THREADS=1 $(CURDIR)/$(BIN)/python -m pytest -n 2 --dist loadfile -q -m "not slow" \
		$(filter-out tests/extensions tests/data tests/reference tests/benchmarks tests/studies,$(patsubst %/,%,$(wildcard tests/*/)))

check: $(STAMP)  ## lint, format, types and docstrings
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --strict $(STRICT)
	$(BIN)/python tools/check_docstrings.py

format: $(STAMP)  ## put the source into the common form
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

bench: $(STAMP)  ## measure speed on this machine, and compare speeds with published ones
	$(BIN)/python benchmarks/engine.py
	$(BIN)/python benchmarks/cameras.py
	$(BIN)/python benchmarks/published_responses.py

docs: $(STAMP)  ## build the pages into site/
	$(BIN)/mkdocs build --strict

clean:  ## remove what was built, the environment included
	rm -rf $(VENV) build dist site .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find src tests examples studies benchmarks tools -name __pycache__ -type d -prune -exec rm -rf {} +

# Python compiles a module when it is first imported, which most never are.
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt

# An environment of the right Python; installed into by each of the two targets below.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "Python >= 3.10 is needed; name one with: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.light-%: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable .
	@rm -f $(VENV)/.light-*
	@touch $@

# torch goes first and alone: where a CPU wheel is at hand pip takes it, and no later step may exchange it. MAVProxy (GPLv3,
# which a test runs as a process) goes last and alone: what it needs is there, and what it asks for exchanges OpenCV.
$(STAMP): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) "$$(grep '^torch==' constraints.txt)"
	$(PIP) --editable ".[$(EXTRAS)]"
	$(PIP) --no-deps "$$(grep '^MAVProxy==' constraints.txt)"
	@rm -f $(VENV)/.installed-*
	@touch $@
