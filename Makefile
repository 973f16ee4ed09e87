PYTHON ?= python3
BIN := .venv/bin
.PHONY: demo test install

demo: install  ## make the synthetic facade, train photo-gs and shellgs on it, compare
	$(BIN)/shellgs demo

# OpenMP's threads spin while they wait; training adapts to what else runs (threads.py), but these tests are short.
test: export OMP_WAIT_POLICY ?= passive
test: install  ## format, lint, types, tests
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/pytest

install: .venv/installed

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	$(BIN)/shellgs doctor --install-libraries
	@touch $@
