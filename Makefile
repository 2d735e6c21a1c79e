PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: docs reference mountings propagation client coverage viewer viewer-test browser screenshots demo lock test test-kernels \
	test-portable test-lowest test-lowest-quick test-newest lint types package audit bom images accuracy openapi clean

# pip takes what builds the package from these too: under the first name until 25.2, under the second from 25.3 on.
PINNED := PIP_CONSTRAINT=$(CURDIR)/constraints.txt PIP_BUILD_CONSTRAINT=$(CURDIR)/constraints.txt

# The environment is made anew when what it holds has changed.
$(VENV)/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	$(PINNED) $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[all,ifc,parquet]' --group dev
	touch $@

# The viewer's files, which the service gives at / and packages hold. Where they cannot be built, the service does without.
CAN_BUILD_VIEWER = command -v npm >/dev/null && node -e \
	'const [a, b] = process.versions.node.split(".").map(Number); process.exit(a > 20 || (a === 20 && b >= 19) ? 0 : 1)'
FRONTEND := service/rayfix_service/web/frontend
VIEWER := service/rayfix_service/web/static/index.html

viewer: $(VIEWER)

$(VIEWER): $(wildcard $(FRONTEND)/*.*) $(shell find $(FRONTEND)/src -type f)
	@if $(CAN_BUILD_VIEWER); then \
		cd $(FRONTEND) && npm ci --no-progress && npm run build; \
	else \
		echo "the viewer is not built: it needs npm and Node.js 20.19 or later"; \
	fi

# The viewer's own tests of its numerics by vitest, and its types and rules by tsc and eslint.
viewer-test:
	@if $(CAN_BUILD_VIEWER); then \
		cd $(FRONTEND) && npm ci --no-progress && npm run lint && npm test; \
	else \
		echo "the viewer's own tests are left out: they need npm and Node.js 20.19 or later"; \
	fi

# The documentation's pages of the site file and of the command line, from the code.
reference: $(VENV)/.done
	$(BIN)/python tools/generate_reference.py

# The documentation as a site, in site/. It reads the code and imports none of it: an environment of its own suffices.
$(VENV)/.docs: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --group docs
	touch $@

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --clean

# The documentation's drawings of how arrays are mounted.
mountings: $(VENV)/.done
	$(BIN)/python tools/draw_mountings.py

# The documentation's pictures of how signals go.
propagation: $(VENV)/.done
	$(BIN)/python tools/draw_propagation.py

# The documentation's pictures, of the demo's table.
screenshots: demo viewer
	$(BIN)/python -m pytest tests/browser/screenshots.py

demo: $(VENV)/.done
	$(BIN)/rayfix demo --output demo

test: $(VENV)/.done
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile --ignore tests/browser

# The numerical tests with the kernels of older processors, on one thread and on two: nothing depends on this one's rounding.
test-portable: $(VENV)/.done
	$(BIN)/python tests/portable.py

# With the lowest versions that pyproject.toml asks for, and with the newest of everything; each in an environment of its own.
test-lowest:
	$(PYTHON) tests/bounds.py lowest

test-lowest-quick:
	$(PYTHON) tests/bounds.py lowest --quick

test-newest:
	$(PYTHON) tests/bounds.py newest

# What the quick tests run of the code; compiled kernels are seen by the tests of their twins alone, without the compiler.
KERNEL_TESTS := tests/service/fusion/test_kernels.py tests/service/fusion/product tests/service/fusion/posterior \
	tests/offline/fit tests/tables/gaussians

# Those tests with the kernels as plain Python, which checks every index.
test-kernels: $(VENV)/.done
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -m "not slow" $(KERNEL_TESTS)

coverage: $(VENV)/.done
	$(BIN)/coverage run --parallel-mode -m pytest -m "not slow" --ignore tests/browser
	NUMBA_DISABLE_JIT=1 $(BIN)/coverage run --parallel-mode -m pytest -m "not slow" $(KERNEL_TESTS)
	$(BIN)/coverage combine
	$(BIN)/coverage report

# In a real browser; what it showed is kept in browser-artefacts/.
browser: $(VENV)/.done viewer
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile tests/browser

lint: $(VENV)/.done
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/python tools/generate_client.py --check
	$(BIN)/python tools/generate_reference.py --check

# The blocking client, from the asynchronous one.
client: $(VENV)/.done
	$(BIN)/python tools/generate_client.py

types: $(VENV)/.done
	$(BIN)/mypy

# The wheel, in an environment of its own and outside the checkout, runs the demo. What the service needs has wheels for arm64.
package: $(VENV)/.done viewer
	rm -rf dist
	$(PINNED) $(BIN)/python -m build --outdir dist .
	$(BIN)/python tests/package/check_wheel.py dist
	$(BIN)/python docker/check_wheels.py

# What the images install, by hashes; after a change of constraints.txt or of what pyproject.toml asks for.
lock: $(VENV)/.done
	$(BIN)/python docker/lock.py

# The images, built and run without a container engine: as root, with buildah and debootstrap.
images: $(VENV)/.done viewer
	$(BIN)/python docker/test_images.py

# Tools that ask for many packages of their own, in an environment of their own.
TOOLS := $(VENV)/tools

$(TOOLS)/.done: Makefile
	$(PYTHON) -m venv $(TOOLS)
	timeout 60 $(TOOLS)/bin/python -m pip install --quiet cyclonedx-bom==7.5.0 pip-audit==2.10.1
	touch $@

# Known vulnerabilities of what the images install fail; a line says what could not be audited, and why.
audit:
	-@$(MAKE) --no-print-directory $(TOOLS)/.done
	@$(PYTHON) tools/audit.py $(TOOLS)/bin/python

# Bills of materials (CycloneDX) of the wheel and the images, beside the wheel in dist/.
bom: $(TOOLS)/.done
	$(TOOLS)/bin/python docker/bill_of_materials.py dist

accuracy: $(VENV)/.done
	$(BIN)/python -m benchmarks.fusion.accuracy

openapi: $(VENV)/.done
	$(BIN)/python -m rayfix_service.server.openapi > docs/openapi.json

clean:
	rm -rf $(VENV) .venv-lowest .venv-newest dist site demo browser-artefacts $(dir $(VIEWER)) $(FRONTEND)/node_modules .pytest_cache .mypy_cache .ruff_cache
