# make demo    render a dataset, fit it, score it and write an HTML report: five minutes, installation included
# make capture-demo  film a chrome ball, capture the film, fit and score it: three minutes on two cores
# make test    every check: format, lint, types, import contracts, documentation, tests
# make results the tables of README and docs: RESOLUTION=400 SCENES="vase cola"; run again to continue
# make docs    build the documentation into build/site
# make format  let ruff rewrite what it can

SHELL := /bin/bash
VENV ?= .venv
BIN := $(VENV)/bin
# Blender's module is built for 3.13 and 3.11; on 3.12 all the rest runs.
KNOWN_PYTHON := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for p in python3.13 python3.11 python3.12 python3; do \
    $$p -c '$(KNOWN_PYTHON)' 2>/dev/null && { echo $$p; break; }; done)
PIP_INSTALL := $(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile -c constraints.txt
# On all cores, which pip does on one; templates that are no Python yet are passed over.
COMPILE := $(BIN)/python -W ignore -m compileall -qq -j 0 $(VENV)/lib || true
CODE := shinypartial panoless tests docs

.PHONY: demo capture-demo test lint kernels results docs format setup clean
.DEFAULT_GOAL := demo

demo: $(VENV)/.installed-demo
	$(BIN)/shinypartial generate --scene vase --resolution 240 --train 48 --test 8
	$(BIN)/panoless fit
	$(BIN)/shinypartial evaluate
	$(BIN)/shinypartial report

capture-demo: $(VENV)/.installed-capture
	$(BIN)/shinypartial film --scene chrome-ball-board --resolution 320 --frames 24 --test 6 --samples 8 --output films/demo
	$(BIN)/panoless capture films/demo --output datasets/film-demo
	$(BIN)/shinypartial align datasets/film-demo --truth films/demo/truth --output datasets/film-demo-aligned
	$(BIN)/panoless fit datasets/film-demo-aligned --preset fast --output predictions/film-demo
	$(BIN)/shinypartial evaluate predictions/film-demo --dataset films/demo/truth

test: setup
	@$(MAKE) --no-print-directory -j2 lint kernels
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --durations=15

lint: setup
	$(BIN)/ruff check $(CODE)
	$(BIN)/ruff format --check $(CODE)
	$(BIN)/mypy shinypartial panoless
	$(BIN)/lint-imports
	$(BIN)/mkdocs build --strict -f docs/mkdocs.yml

# A small fit compiles the kernels of surfels once, beside the checks, in place of once in every process of the tests.
# Other kinds have few kernels: their fits take longer than compiling them twice.
kernels: setup
	@rm -rf build/kernels && mkdir -p build/kernels
	@cd build/kernels && $(abspath $(BIN))/panoless fit tiny-vase --preset fast --model surfels --output surfels \
	  >log.txt 2>&1 || { cat log.txt; exit 1; }

RESOLUTION ?= 400
SCENES ?=
results: $(VENV)/.installed-demo
	$(BIN)/python docs/examples/main_scenes.py --resolution $(RESOLUTION) --scenes $(SCENES)

docs: setup
	$(BIN)/mkdocs build --strict -f docs/mkdocs.yml

format: setup
	$(BIN)/ruff check --fix $(CODE)
	$(BIN)/ruff format $(CODE)

setup: $(VENV)/.installed-dev

$(VENV)/.installed-demo: extras := fit,blender
$(VENV)/.installed-capture: extras := fit,blender,capture
$(VENV)/.installed-dev: extras := dev
$(VENV)/.installed-demo $(VENV)/.installed-capture $(VENV)/.installed-dev: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" && $(PYTHON) -c '$(KNOWN_PYTHON)' || { \
	  echo "error: expected Python 3.13, 3.12 or 3.11" >&2; \
	  echo "       found    $$($(or $(PYTHON),python3) --version 2>&1 | head -n 1)" >&2; \
	  echo "       remedy   Install Python 3.13, or name it: make PYTHON=/path/to/python3.13 $(MAKECMDGOALS)" >&2; \
	  exit 2; }
	@test -x $(BIN)/pip || { echo "Making $(VENV) …"; $(PYTHON) -m venv --clear $(VENV); }
	@echo "Installing panoless[$(extras)] into $(VENV): a minute here, longer where torch comes with CUDA …"
	@$(PIP_INSTALL) -e '.[$(extras)]'
	@$(COMPILE)
	@touch $@

clean:
	rm -rf $(VENV) build .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
