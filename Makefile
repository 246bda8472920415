# Two commands from a machine that has only Python 3.11 or newer (with pip) and make:
#   make demo   the whole chain, small, in about a minute
#   make test   lint, types and tests
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test
demo: .venv/demo.ok
	$(BIN)/kpbench demo

test: .venv/test.ok
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2

.venv/bin/pip:
	$(PYTHON) -m venv .venv

.venv/demo.ok: .venv/bin/pip pyproject.toml constraints.txt
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

.venv/test.ok: .venv/bin/pip pyproject.toml constraints.txt
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@
