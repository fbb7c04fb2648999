# make install: the package in .venv; make demo: a whole transfer on shipped captures;
# make dev: also what the checks need; make test: all checks but the long ones, 9 to 12 minutes on two idle cores;
# make test-all: the long ones too, and shapes checked at every call; make test-fast: pytest alone without a browser;
# make blender: Blender 4.2 as a Python module in .venv-blender, for `splatgraft paper synth --blender-python`, and
# Blender 5.3 in .venv-blender5, for the tests of the add-on; make extension: the add-on as an extension with its index;
# make exam NUMBER=...: the light transfer measured on new scenes drawn from a number that no exam has used;
# make browser: Chromium, for the editor's tests.
SHELL := /bin/bash
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
STAMP := .venv/.installed
DEV_STAMP := .venv/.installed-dev
# threads of torch and numba that spin while they wait take the cores from each other
export OMP_WAIT_POLICY ?= passive

.PHONY: install dev demo test test-all test-fast blender browser clean
.DEFAULT_GOAL := install

# the package alone: what `make demo` needs
install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "make: expected Python 3.11 or newer, found " + sys.version.split()[0] + "; name one with PYTHON=...")'
	@echo "installing splatgraft into .venv: a download of about 390 MB, 1.6 GB on disk with PyTorch for the CPU, usually 1 to 2 minutes"
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	@touch $@

# what the checks need besides: linters, Ray, diffusers, ONNX, pycolmap, a driver for Chromium
dev: $(DEV_STAMP)

$(DEV_STAMP): $(STAMP)
	@echo "installing what the checks need into .venv: a download of about 330 MB, 1.1 GB more on disk, usually 1 to 2 minutes"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: install
	$(BIN)/splatgraft demo demo

# each of Blender's wheels is for one version of Python: environments of their own
BLENDER_PYTHON ?= $(shell command -v python3.11)
BLENDER5_PYTHON ?= $(shell command -v python3.13)
blender: .venv-blender/.installed .venv-blender5/.installed

.venv-blender/.installed: constraints.txt
	@test -n "$(BLENDER_PYTHON)" || { echo "make: expected Python 3.11 for bpy, found none; name one with BLENDER_PYTHON=..."; exit 1; }
	@echo "installing Blender 4.2 as a Python module into .venv-blender: a download of 334 MB, 1 GB on disk"
	$(BLENDER_PYTHON) -m venv .venv-blender
	.venv-blender/bin/python -m pip install --quiet --disable-pip-version-check 'bpy==4.2.23' numpy==2.4.6
	@touch $@

.venv-blender5/.installed: constraints.txt
	@$(or $(BLENDER5_PYTHON),false) --version >/dev/null 2>&1 || { echo "make: expected Python 3.13 for bpy 5.3, found none; name one with BLENDER5_PYTHON=..."; exit 1; }
	@echo "installing Blender 5.3 as a Python module into .venv-blender5: a download of 428 MB, 1.1 GB on disk"
	$(BLENDER5_PYTHON) -m venv .venv-blender5
	.venv-blender5/bin/python -m pip install --quiet --disable-pip-version-check 'bpy==5.3.0' numpy==2.5.5
	@touch $@

# the add-on as an extension, and an index.json that makes its folder a repository of extensions; Blender's own program
# for extensions, which comes with bpy, builds and checks both
BLENDER ?= .venv-blender/bin/python
EXTENSION ?= build/extension
.PHONY: extension
extension: $(if $(filter .venv-blender/bin/python,$(BLENDER)),.venv-blender/.installed)
	@rm -rf build/addon $(EXTENSION) && mkdir -p build/addon $(EXTENSION)
	@cp blender_addon/splatgraft_addon.py build/addon/__init__.py
	@cp blender_addon/blender_manifest.toml LICENSE build/addon
	@tool=$$($(BLENDER) -c "import importlib.util as u, pathlib as p; print(*p.Path(u.find_spec('bpy').origin).parent.glob('*/scripts/addons_core/bl_pkg/cli/blender_ext.py'))") && \
	  $(BLENDER) $$tool build --source-dir build/addon --output-dir $(EXTENSION) && \
	  $(BLENDER) $$tool validate $(EXTENSION)/*.zip && \
	  $(BLENDER) $$tool server-generate --repo-dir $(EXTENSION) --html
	@echo "$(EXTENSION)/index.json"

# an exam of the light transfer on new scenes: about 3 CPU-minutes a scene to render, 3 to reconstruct, 1 to measure
.PHONY: exam
exam: install .venv-blender/.installed
	@test -n "$(NUMBER)" || { echo "make: expected NUMBER=..., a number that no exam has used, found none"; exit 1; }
	$(BIN)/splatgraft paper exam $(NUMBER) --blender-python .venv-blender/bin/python

# Debian's Chromium with software OpenGL, for the stories of the editor; apt is used by root alone
browser:
	@command -v chromium >/dev/null && exit 0; \
	if [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then \
	  echo "no chromium found: install the packages chromium libgl1-mesa-dri libegl1 (about 400 MB on disk) for the browser tests"; exit 1; fi; \
	echo "installing Chromium by apt-get for the browser tests: a download of about 130 MB, 400 MB on disk"; \
	apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium libgl1-mesa-dri libegl1 >/dev/null

test:
	.ci/run

test-all:
	.ci/run --all

# the inner loop
test-fast: dev
	$(BIN)/python -m pytest -q -n 2 --dist loadscope -m "not browser and not long"

# the documentation site in build/site; strict: a broken link or a missing page ends it
.PHONY: docs docs-tools
docs: dev docs-tools
	NO_MKDOCS_2_WARNING=true $(BIN)/mkdocs build --quiet --strict
	@echo "build/site/index.html"

docs-tools: dev
	@$(BIN)/python -c 'import mkdocs, mkdocstrings' 2>/dev/null || \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'

clean:
	rm -rf demo build .pytest_cache .ruff_cache .hypothesis
