# `make demo` and `make test` set up all they need by themselves, in .venv.
# Another interpreter: PYTHON=python3.12 make demo

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install demo docs notebooks paper test test-slow fuzz kills soak audit lowest wheel lint clean

install: $(VENV)/.runtime

$(VENV)/.runtime: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "jaxshape needs Python 3.11 or newer; this is " + sys.version.split()[0] + ". Name another: PYTHON=python3.12 make ...")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/.develop: $(VENV)/.runtime
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

demo: $(VENV)/.runtime
	$(BIN)/jaxshape demo

# Every figure of the paper, and the README's table: about two hours on two cores. Killed, it goes on
# where it stopped. The 78 CAD seats come from a Debian and an
# npm package (npm and dpkg-deb are needed); without a recording in KITCHEN, real_chair.py is left out.
PAPER := convergence step_size iou_by_frames gallery gradient_failures equal_budget objective
KITCHEN ?= kitchen/frames

paper: export OPENBLAS_NUM_THREADS = 1
paper: export JAX_COMPILATION_CACHE_DIR ?= out/compiled
paper: $(VENV)/.runtime cad_chairs
	for script in $(PAPER); do \
		$(BIN)/python experiments/$$script.py --test.meshes cad_chairs || exit 1; \
	done
	test ! -d $(KITCHEN) || $(BIN)/python experiments/real_chair.py --recording $(KITCHEN)

cad_chairs: $(VENV)/.runtime
	mkdir -p packages
	cd packages && apt-get download sweethome3d-furniture && dpkg-deb -x sweethome3d-furniture_*.deb .
	cd packages && npm pack open3dfloorplan@1.1.4 && tar -xzf open3dfloorplan-1.1.4.tgz
	$(BIN)/python experiments/cad_seats.py --packages packages --output cad_chairs

# One process for each core. Most of their time goes into compiling, so they share compiled programs,
# which also serve the next run, and compile quickly, as commands do.
FLAGS := import os; from jaxshape.process import compile_quickly; \
	compile_quickly(); print(os.environ.get("XLA_FLAGS", ""))

test: export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/out/compiled
test: export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS ?= 0.2
test: $(VENV)/.develop
	XLA_FLAGS="$$($(BIN)/python -c '$(FLAGS)')" OPENBLAS_NUM_THREADS=1 \
		$(BIN)/python -m pytest -n auto --dist loadfile

test-slow: $(VENV)/.develop
	$(BIN)/python -m pytest -m slow

# Every reader against damaged files for FUZZ_SECONDS; what breaks one is left as crash-... here.
# atheris needs Python 3.11 to 3.13 and Linux.
FUZZ_SECONDS ?= 120
READERS := json trajectory box journal image recording npz mesh cloud weights result

fuzz: $(VENV)/.develop
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[fuzz]'
	for reader in $(READERS); do \
		$(BIN)/python tests/fuzz/fuzz.py $$reader -max_total_time=$(FUZZ_SECONDS) -timeout=25 \
			-rss_limit_mb=4096 -print_final_stats=1 || exit 1; \
	done

# Commands are killed at random and given again; they end as if nothing had been.
KILLS ?= 50

kills: $(VENV)/.develop
	$(BIN)/python tests/kills.py --kills $(KILLS)

# Many recordings in one process and in many, and a dataset of many meshes. About two hours on two
# cores.
RECORDINGS ?= 200
MESHES ?= 10000

soak: $(VENV)/.develop
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/soak.py --recordings $(RECORDINGS) --meshes $(MESHES)

# Known vulnerabilities of what is installed.
audit: $(VENV)/.develop
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[audit]'
	$(BIN)/python -m pip_audit --skip-editable

# The oldest versions that pyproject.toml allows, in an environment of their own, and the tests there
# without the checks of types.
lowest: $(VENV)/.develop
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/python -m uv pip compile --quiet --resolution lowest-direct --extra dev \
		--output-file out/lowest.txt pyproject.toml
	$(BIN)/python -m uv venv --quiet --python $(BIN)/python out/lowest
	$(BIN)/python -m uv pip install --quiet --python out/lowest/bin/python -r out/lowest.txt
	$(BIN)/python -m uv pip install --quiet --python out/lowest/bin/python --no-deps --editable .
	OPENBLAS_NUM_THREADS=1 out/lowest/bin/python -m pytest -n auto --dist loadfile \
		--override-ini "addopts=-m 'not slow'"

# Into out/site; a warning is an error.
docs: $(VENV)/.runtime
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

# The notebooks of docs/notebooks as .ipynb files, into out/notebooks.
notebooks: $(VENV)/.runtime
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	mkdir -p out/notebooks
	for script in docs/notebooks/*.py; do \
		$(BIN)/python -m jupytext --quiet --from py:percent --to ipynb $$script \
			--output out/notebooks/$$(basename $$script .py).ipynb || exit 1; \
	done

# Built, installed into a fresh environment, and tried from an empty folder.
wheel: $(VENV)/.runtime
	$(BIN)/python -m pip install --quiet --disable-pip-version-check build
	rm -rf out/wheel && $(BIN)/python -m build --quiet --wheel --outdir out/wheel
	find out/wheel -name '*.whl' -size -20000k | grep .
	$(PYTHON) -m venv out/wheel/venv
	out/wheel/venv/bin/python -m pip install --quiet --disable-pip-version-check out/wheel/*.whl
	mkdir out/wheel/empty && cd out/wheel/empty && ../venv/bin/jaxshape doctor && ../venv/bin/jaxshape demo

lint: $(VENV)/.develop
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

clean:
	rm -rf $(VENV) out
