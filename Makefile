PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test lint types package accuracy clean

# The environment is made anew when what it holds has changed.
$(VENV)/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: $(VENV)/.done
	$(BIN)/rayfix demo --output demo

test: $(VENV)/.done
	$(BIN)/python -m pytest

lint: $(VENV)/.done
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(VENV)/.done
	$(BIN)/mypy

# The wheel, in an environment of its own and outside the checkout, runs the demo.
package: $(VENV)/.done
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python tests/package/check_wheel.py dist

accuracy: $(VENV)/.done
	$(BIN)/python benchmarks/accuracy.py

clean:
	rm -rf $(VENV) dist demo .pytest_cache .mypy_cache .ruff_cache
