# Everything a person does with the repository; each target sets up what it needs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
export PATH := $(CURDIR)/$(BIN):$(PATH)
# No telemetry at import time, and no core asked to do two things at once.
export MLFLOW_DISABLE_TELEMETRY := true
export DVC_NO_ANALYTICS := 1
export DO_NOT_TRACK := 1
# Python keeps what it has compiled: else each process of the tests compiles all sources again, 10 s for some.
unexport PYTHONDONTWRITEBYTECODE
PORT ?= 5000
# One a core computes, two keep time: tests of loops and servers mostly wait, see tests/scheduling.py. Each takes 1.2 GB.
WORKERS ?= $(shell $(PYTHON) -c 'import os; print((os.cpu_count() or 1) + 2)')

.DEFAULT_GOAL := help
.PHONY: help setup run test check quick docs coverage registry bench release clean

help: ## list the targets
	@awk -F':.*## ' '/^[a-z]+:.*## /{printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP) ## make the virtual environment .venv (the others call it)

$(STAMP): pyproject.toml setup.py constraints.txt serving/version.py tools/setup.sh
	@PYTHON="$(PYTHON)" bash tools/setup.sh "$(VENV)"
	@touch $@

run: $(STAMP) ## run the whole pipeline: screen, excite, fit, design, validate, report, publish
	@loopwright run

test: quick ## formatting, lint, types, import rules, tests
	@bash tools/tests.sh -n $(WORKERS) --dist loadfile --no-loadscope-reorder --ignore=tests/release

check: quick ## the static part of make test
	lint-imports
	mypy

quick: $(STAMP) # what takes seconds
	ruff format --check .
	ruff check .

docs: $(STAMP) ## build the manual into build/docs, under a minute
	@$(BIN)/python -c "import furo, myst_nb" 2> /dev/null || \
	  $(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[docs]'
	$(BIN)/python -m sphinx -q -W --keep-going -d build/doctrees -c docs . build/docs
	@echo "open build/docs/index.html"

coverage: $(STAMP) ## branch coverage of the tests, by file
	python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --cov=serving --cov=pipeline --cov-branch --cov-report=term:skip-covered

registry: $(STAMP) ## open MLflow's UI on localhost, port PORT (5000); publishes first what the store lacks
	loopwright registry publish
	loopwright registry serve --port $(PORT)

bench: $(STAMP) ## run the benchmarks, about 15 minutes
	@echo "benchmarks: about 15 minutes; each says beforehand what it measures and how long it takes"
	@for script in $(filter-out benchmarks/identification.py,$(wildcard benchmarks/[a-z]*.py)); do echo "== $$script"; python $$script || exit 1; done

release: $(STAMP) ## build wheel, source archive, bill of materials and licences into dist/, run tests/release: 11 minutes
	@PYTHON=python bash tools/release.sh
	python -m pytest -n 2 --dist loadfile --no-loadscope-reorder tests/release

clean: ## remove what can be rebuilt (the virtual environment stays)
	rm -rf work timing receipts published.json mlflow.db mlruns mlartifacts .pytest_cache .mypy_cache .ruff_cache build dist
