# Two commands set everything up on a machine with Python 3.11 and nothing else:
#   make demo   fly, learn, land, upload, fly again, on a simulated aircraft over real UDP
#   make test   ruff, mypy --strict and every test but those marked long, which `make soak` runs
# Both make their own environment in .venv; nothing touches the system Python.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
UV_VERSION := 0.13.9
export UV_PROJECT_ENVIRONMENT := $(CURDIR)/$(VENV)

.PHONY: demo test check soak bench papers estimators real cost clean

$(VENV)/.ready: pyproject.toml uv.lock
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || \
	  { rm -rf $(VENV); echo "python3-venv is missing: installing it" >&2; \
	    apt-get update -qq && apt-get install -y -qq python3-venv && $(PYTHON) -m venv $(VENV); }
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)
	@$(BIN)/uv sync --quiet --frozen --inexact
	@touch $@

demo: $(VENV)/.ready
	$(BIN)/magmav demo --out demo

test: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n 3

# Hours on two cores; each takes how much as its first argument, and tells what it has when it is cut short.
soak: $(VENV)/.ready
	$(BIN)/pytest -n 2 -m long
	$(BIN)/pytest -n 2 -m hypothesis --hypothesis-profile=searching
	$(BIN)/python benchmarks/soak.py
	$(BIN)/python benchmarks/soak_upload.py
	$(BIN)/python benchmarks/fuzz_wire.py
	$(BIN)/python benchmarks/damaged_logs.py
	$(BIN)/python benchmarks/day.py

# The last wants a real .bin log and says so (exit 3) where there is none.
bench: $(VENV)/.ready
	$(BIN)/python benchmarks/throughput.py
	$(BIN)/python benchmarks/fleet_cost.py
	$(BIN)/python benchmarks/logs.py || test $$? -eq 3

papers: $(VENV)/.ready
	$(BIN)/python benchmarks/papers.py

estimators: $(VENV)/.ready
	$(BIN)/python benchmarks/estimators.py

# Wants the real recordings and says so (exit 3) where there are none.
real: $(VENV)/.ready
	$(BIN)/python benchmarks/real_flights.py || test $$? -eq 3

cost: $(VENV)/.ready
	$(BIN)/python benchmarks/estimator_cost.py

clean:
	rm -rf $(VENV) demo dist build .pytest_cache .mypy_cache .ruff_cache .hypothesis
