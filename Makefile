# Two commands for a fresh machine: `make demo` and `make test`. Each makes its own virtual
# environment in .venv and installs what it needs, at the versions of .ci/constraints.txt.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check \
	--constraint .ci/constraints.txt

.PHONY: demo test lint types docs clean

demo: $(VENV)/demo-installed
	$(BIN)/python -m sb3_policyflow.benchmark demo

test: $(VENV)/tests-installed
	$(BIN)/python -m pytest --numprocesses 2 $(PYTEST_ARGS)

lint: $(VENV)/tests-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/tests-installed
	$(BIN)/mypy sb3_policyflow

docs: $(VENV)/docs-installed
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

clean:
	rm -rf $(VENV) docs/_build build dist

$(VENV)/demo-installed: EXTRAS := plots,zoo
$(VENV)/tests-installed: EXTRAS := tests
$(VENV)/docs-installed: EXTRAS := docs

$(VENV)/%-installed: pyproject.toml .ci/constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) torch
	$(INSTALL) --editable ".[$(EXTRAS)]"
	touch $@
