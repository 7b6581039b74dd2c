# `make run` and `make test` work as the first command in a fresh clone.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
# The recorded flight lies inside this package; what it would install besides is not needed.
FLIGHT = traffic==2.13

.PHONY: run test ordeals check bench ledger baselines clean

run: $(VENV)/.installed
	$(BIN)/hybridtrack run configs/rmimm_fig5.yaml

test: $(VENV)/.installed
	$(BIN)/python -m pytest

ordeals: $(VENV)/.installed
	$(BIN)/python -m pytest tests/ordeals

check: $(VENV)/.installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

bench: $(VENV)/.installed
	$(BIN)/python benchmarks/run.py

# One thread for matrices, as the commands have: a local solver's last bits depend on their number.
ledger: $(VENV)/.installed
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/readme.py

# What tests/test_baselines.py holds every shipped scenario against; say in CHANGELOG.md why.
baselines: $(VENV)/.installed
	for file in configs/*.yaml; do \
		name=$$(basename $$file .yaml); \
		runs=128; [ $$name = recorded_flight ] && runs=20; \
		$(BIN)/hybridtrack baseline $$name --runs $$runs --quiet \
			-o tests/baselines/$$name.parquet || exit; \
	done

$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "hybridtrack needs Python 3.11 or later: make PYTHON=python3.11 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt --editable '.[dev]'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps $(FLIGHT)
	@touch $@

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
