# Two commands do everything; each works from a bare clone with Python 3.11+ and make.
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
PORT ?= 8000

.PHONY: up test test-postgres test-faults lint clean help

help:
	@echo "make up          set up, start everything, scan the demo knife, stay up until Ctrl-C"
	@echo "make up ONCE=1   the same, then stop; exit 0 only if R1, R2 and R3 were measured"
	@echo "make test        install what the tests need and run them all"
	@echo "make test-postgres  the tests of pages, queue and workers on a scratch PostgreSQL and Redis, where installed"
	@echo "make test-faults kill -9 of each process at 50 random moments of a scan, and the long fuzz (an hour or more)"
	@echo "make lint        ruff, mypy, import-linter"

up: $(VENV)/.installed
	@exec $(PY) manage.py up --port $(PORT) $(if $(filter-out 0,$(ONCE)),--once)

test: $(VENV)/.installed-dev
	$(PY) -m pytest -n 2 --dist loadfile $(ARGS)

test-postgres: $(VENV)/.installed-dev
	$(PY) -m tests.postgres tests/inspection tests/worker tests/faults -n 2 --dist loadfile $(ARGS)

test-faults: $(VENV)/.installed-dev
	TEST_KILLS=50 TEST_FUZZ=10000 $(PY) -m pytest tests/faults -s $(ARGS)

lint: $(VENV)/.installed-dev
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(VENV)/bin/lint-imports
	$(PY) -m mypy

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Edgewatch needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version). Set PYTHON=/path/to/python3.11."; exit 1; }
	@$(PYTHON) -c 'import ensurepip' || { echo "Python's venv module is incomplete; on Debian: apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(VENV)

# uv, where it is on the PATH, installs the same hashed list in seconds instead of a minute.
$(VENV)/.installed: requirements.txt | $(VENV)/bin/python
	@echo "Installing (about a minute the first time) ..."
	@if command -v uv >/dev/null; then uv pip install -q --python $(PY) --require-hashes -r requirements.txt; \
	else $(PY) -m pip install -q --disable-pip-version-check --require-hashes -r requirements.txt; fi
	@touch $@

$(VENV)/.installed-dev: requirements-dev.txt $(VENV)/.installed
	@if command -v uv >/dev/null; then uv pip install -q --python $(PY) --require-hashes -r requirements-dev.txt; \
	else $(PY) -m pip install -q --disable-pip-version-check --require-hashes -r requirements-dev.txt; fi
	@touch $@

clean:
	rm -rf $(VENV) var .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
