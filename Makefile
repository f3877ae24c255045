# Two commands on a fresh machine with python3, venv and make: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin

OLDEST := .venv-lowest/bin
TESTS ?= tests

.PHONY: demo test test-lowest lint install system clean

demo: install
	$(BIN)/lidarflow demo --out demo

test: install lint
	$(BIN)/python -m pytest

# The oldest versions that pyproject.toml allows; `make test` has the newest, as pip finds them.
test-lowest: system .venv-lowest/installed
	$(OLDEST)/python -m pytest -m "not slow" $(TESTS)

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

.venv-lowest/installed: pyproject.toml
	$(PYTHON) -m venv .venv-lowest
	$(OLDEST)/python -m pip install --quiet uv
	$(OLDEST)/uv pip install --quiet --python $(OLDEST)/python --resolution lowest-direct --editable '.[dev]'
	@touch $@

clean:
	rm -rf .venv .venv-lowest demo build dist
