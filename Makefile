# make run [CASE=name|all]   run a case from raw telemetry to its table of scores
# make notebooks             open the notebooks in JupyterLab
# make view [CASE=name]      open a case's recordings in the Rerun viewer
# make test                  everything that CI checks
# make endurance             hours of kills, turned bits and mutated inputs
# make install               create .venv with the pinned development tools
# make lock                  write constraints.txt and the hashes in requirements/ again

CASE ?= ieee33
VENV := .venv
BIN := $(VENV)/bin
BASE := $(shell command -v python3.11 || command -v python3)
PIP_INSTALL := -m pip install --quiet --disable-pip-version-check
HASHED := $(PIP_INSTALL) --require-hashes
LOCK = $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --no-annotate \
	--no-emit-index-url --custom-compile-command "make lock"
NOTEBOOKS := $(wildcard notebooks/*.ipynb)

.DEFAULT_GOAL := run
.PHONY: run notebooks view test lint types tests cases-all notebook-tests endurance install lock clean

run: $(VENV)/.runtime
	@$(BIN)/pse run $(CASE)

notebooks: $(VENV)/.dev
	$(BIN)/jupyter lab notebooks

view: run
	@$(BIN)/pse view $(CASE)

install: $(VENV)/.dev

test: lint types cases-all notebook-tests tests

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/mypy

cases-all: $(VENV)/.dev
	$(BIN)/pse run all

# The notebooks read what the cases left behind. Warnings of notebook machinery are not ours to mend.
# What they say of thirty seeds takes a quarter of an hour; here four show that it can be had.
notebook-tests: $(VENV)/.dev cases-all
	$(if $(NOTEBOOKS),PSE_SEEDS=4 $(BIN)/python -m pytest -n 2 --nbmake --nbmake-timeout=600 -W default $(NOTEBOOKS),@true)

tests: $(VENV)/.dev
	$(BIN)/python -m pytest -n 2 tests

# What it found last, on which machine and when: docs/reliability.md.
endurance: $(VENV)/.dev
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.endurance kills --count $(or $(KILLS),1000)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.endurance flips --count $(or $(FLIPS),10000)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.endurance mutations --count $(or $(MUTATIONS),100000)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.endurance filters --count $(or $(STEPS),100000)

clean:
	rm -rf $(VENV) data/processed/*/ .pytest_cache .mypy_cache .ruff_cache

# Pins are kept as they are, unless a file that asks for a package no longer allows them. All of
# them anew: make lock UPGRADE=--upgrade
lock: $(VENV)/.dev
	$(LOCK) pyproject.toml requirements/build.in --extra dev $(UPGRADE) -o constraints.txt
	$(LOCK) requirements/build.in -c constraints.txt --generate-hashes -o requirements/build.txt
	$(LOCK) pyproject.toml -c constraints.txt --generate-hashes -o requirements/run.txt
	$(LOCK) pyproject.toml --extra dev -c constraints.txt --generate-hashes -o requirements/dev.txt

# Debian keeps ensurepip in a package of its own; where it is missing, the pip that is there serves.
$(BIN)/python:
	@test -n "$(BASE)" || { echo "no python3: install Python 3.11 or later"; exit 1; }
	@$(BASE) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "expected Python 3.11 or later, found $$($(BASE) --version) at $(BASE)"; exit 1; }
	@echo "creating $(VENV) with $(BASE)"
	@$(BASE) -m venv $(VENV) 2>/dev/null || \
		{ rm -rf $(VENV); $(BASE) -m venv --without-pip $(VENV) && touch $(VENV)/.without_pip; } || \
		{ rm -rf $(VENV); echo "no venv: install it first, on Debian: apt-get install python3-venv"; exit 1; }
	@test ! -e $(VENV)/.without_pip || \
		$(BASE) -m pip --python $@ install --quiet --require-hashes -r requirements/build.txt || \
		{ rm -rf $(VENV); exit 1; }

# Every package is compared with its hash before anything of it runs. The package itself is built
# by the setuptools that was: nothing is fetched for it. A development install holds the runtime
# too, so that it satisfies both stamps.
$(VENV)/.runtime: pyproject.toml requirements/build.txt requirements/run.txt | $(BIN)/python
	@echo "installing pse_analysis into $(VENV)"
	@$(BIN)/python $(HASHED) -r requirements/build.txt
	@$(BIN)/python $(HASHED) -r requirements/run.txt
	@$(BIN)/python $(PIP_INSTALL) --no-index --no-deps --no-build-isolation -e .
	@touch $@

$(VENV)/.dev: pyproject.toml requirements/build.txt requirements/dev.txt | $(BIN)/python
	@echo "installing pse_analysis and its development tools into $(VENV)"
	@$(BIN)/python $(HASHED) -r requirements/build.txt
	@$(BIN)/python $(HASHED) -r requirements/dev.txt
	@$(BIN)/python $(PIP_INSTALL) --no-index --no-deps --no-build-isolation -e .
	@touch $@ $(VENV)/.runtime
