# Two commands for a fresh machine: `make demo` and `make test`. Each makes its own virtual
# environment in .venv and installs what it needs, at the versions of .ci/constraints.txt.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Shows what it downloads, except in continuous integration.
INSTALL := $(BIN)/python -m pip install $(if $(CI),--quiet) --disable-pip-version-check \
	--constraint .ci/constraints.txt

PLAYGROUND_TESTS := tests/envs/test_playground.py tests/envs/test_playground_tasks.py \
	tests/integrations/rl_zoo3/test_playground_commands.py \
	tests/integrations/rl_zoo3/test_experiment.py

.PHONY: demo test test-fast test-playground lint types docs check-pages clean

demo: $(VENV)/demo-installed
	$(BIN)/python -m sb3_policyflow.benchmark demo

test: $(VENV)/tests-installed
	$(BIN)/python -m pytest --numprocesses 2 $(PYTEST_ARGS)

# A minute, for while one works: every part is touched, and what takes seconds is left out.
test-fast: $(VENV)/tests-installed
	$(BIN)/python -m pytest -m "not slow" --numprocesses 2 $(PYTEST_ARGS)

# MuJoCo Playground brings 1.5 GB of simulators, and each of its tasks takes long to compile.
test-playground: $(VENV)/playground-installed
	$(BIN)/python -m pytest $(PLAYGROUND_TESTS) $(PYTEST_ARGS)

lint: $(VENV)/tests-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/tests-installed
	$(BIN)/mypy sb3_policyflow

docs: $(VENV)/docs-installed
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

# As a reader sees the pages. Needs Chromium, from the system's packages.
check-pages: docs $(VENV)/browser-installed
	$(BIN)/python tests/scripts/check_pages.py docs/_build/html

clean:
	rm -rf $(VENV) docs/_build build dist

$(VENV)/demo-installed: EXTRAS := plots,zoo
$(VENV)/tests-installed: EXTRAS := tests
$(VENV)/docs-installed: EXTRAS := docs
$(VENV)/browser-installed: EXTRAS := browser
$(VENV)/playground-installed: EXTRAS := tests,playground

$(VENV)/%-installed: pyproject.toml .ci/constraints.txt
	@echo "Installing into $(VENV), once; this takes two minutes or so."
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) torch
	$(INSTALL) --editable ".[$(EXTRAS)]"
	touch $@
