# From a bare checkout with Python 3.10-3.12, a C compiler and make: `make demo`, `make test`, `make lint`.

PYTHON ?= python3
VENV ?= .venv
# Test processes. One, with torch's threads, took 25 s on two cores where two processes took 53 s.
JOBS ?= 0

BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint clean

demo: $(STAMP)
	$(BIN)/python -m sadgs_ns.demo

test: $(STAMP)
	$(BIN)/python -m pytest -n $(JOBS)

lint: $(STAMP)
	$(BIN)/ruff check sadgs_ns tests
	$(BIN)/ruff format --check sadgs_ns tests
	$(BIN)/pyright --pythonpath $(BIN)/python

# The stamp is written last, so an interrupted installation is taken up again.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))' || { \
	  echo 'sadgs_ns needs Python 3.10, 3.11 or 3.12, and "$(PYTHON)" is not one; name one: make PYTHON=python3.11' >&2; \
	  exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) demo-output outputs build *.egg-info .pytest_cache .ruff_cache .hypothesis
	find sadgs_ns tests -name __pycache__ -type d -prune -exec rm -rf {} +
