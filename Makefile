PYTHON ?= python3
BIN := .venv/bin
.PHONY: demo test docs
.NOTPARALLEL:

demo: .venv/checked  ## install; make the synthetic facade, train photo-gs and shellgs-metric on it, compare
	$(BIN)/shellgs demo

# Threads of OpenMP and of BLAS spin while they wait; training adapts to what else runs (threads.py), but these tests are short.
# Where a container forbids Python to write bytecode, each process of the tests would compile all modules again.
test: export OMP_WAIT_POLICY ?= passive
test: export OPENBLAS_NUM_THREADS ?= 1
test: export PYTHONDONTWRITEBYTECODE =
test: .venv/dev .venv/checked  ## install; format, lint, types, imports, tests
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports --no-cache
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

docs: .venv/docs  ## the pages, in build/docs; broken links are errors
	$(BIN)/sphinx-build -W --keep-going -q docs build/docs

.venv/checked: .venv/shellgs  # not written where something is missing
	$(BIN)/shellgs doctor
	@touch $@

.venv/shellgs: pyproject.toml
	@$(PYTHON) shellgs_method/machine/system.py
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --editable .
	@touch $@

.venv/dev .venv/docs: .venv/%: .venv/shellgs
	$(BIN)/python -m pip install --quiet --editable '.[$*]'
	@touch $@
