# Two commands on a fresh machine with python3, venv and make: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test lint install system clean

demo: install
	$(BIN)/lidarflow demo --out demo

test: install lint
	$(BIN)/python -m pytest

lint: install
	$(BIN)/ruff check lidarflow scripts tests
	$(BIN)/mypy

install: system .venv/installed

system:
	@sh scripts/system_libraries.sh

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@

clean:
	rm -rf .venv demo build dist
