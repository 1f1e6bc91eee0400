# Every target makes what it needs first; nothing has to be activated or sourced.
#   make setup   .venv with the locked dependencies and the package in it
#   make demo    the arm catches 20 kg, live: picture, bag and numbers in demo_output/; DEMO_ARGS=--view: in a browser
#   make test    the test suite; among it a colcon build whose executables are started
#   make lint    ruff and mypy
#   make bench   every benchmark; table and JSON in benchmarks/results/
#   make docs    the pages that are generated from the code, then the site: build/html/index.html
#   make test-wheel  the wheel in a fresh environment, with every command of the first pages
#   make test-jazzy  the test suite on the versions of Ubuntu 24.04; needs a Python 3.12
#   make lock    the dependencies anew, from requirements/*.in
SHELL := /bin/sh
.DEFAULT_GOAL := help
VENV := .venv
BIN := $(VENV)/bin
# Two environments of their own: what builds the site, and the versions of Ubuntu 24.04.
DOCS := .venv-docs
JAZZY := .venv-jazzy
QUIETLY := -m pip --disable-pip-version-check --quiet --quiet
# Python compiles a module when it is first imported. To compile all of them took half of the time of an installation. A
# lock names every dependency, so pip need not look for them in the packages (a sixth of its time).
LOCKED := install --no-compile --no-deps --require-hashes -r
PIP := $(BIN)/python $(QUIETLY)

# A sourced ROS must not mix its libraries with the locked ones in the venv.
unexport PYTHONPATH LD_LIBRARY_PATH AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH
unexport ROS_DISTRO RMW_IMPLEMENTATION VIRTUAL_ENV PIP_REQUIRE_VIRTUALENV PYTHONDONTWRITEBYTECODE
export ROS_LOG_DIR := $(CURDIR)/log/ros
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
export MPLBACKEND := Agg
# The kernels are compiled and serial; idle BLAS threads would only steal cores from the other nodes.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

SOURCES := $(shell find flexmanip_ros -name '*.py')
SHARED := $(shell find config launch resource -type f -not -path '*/__pycache__/*')

# A venv that was moved, or whose interpreter has gone, is made again with its stamps.
$(foreach folder,$(VENV) $(DOCS) $(JAZZY),$(shell requirements/make_venv.sh --drop-broken $(folder)))

.PHONY: help setup demo test test-wheel test-jazzy lint bench docs lock clean
help:
	@sed -n 's/^#   make/  make/p' Makefile

# The kernels need five of the libraries. They compile while the others are installed.
setup:
	@$(MAKE) --no-print-directory -j2 $(VENV)/.warm $(VENV)/.package

$(VENV)/.python:
	@requirements/make_venv.sh $(VENV)
	@touch $@

$(VENV)/.compiler: requirements/runtime.txt | $(VENV)/.python
	@echo 'Installing the locked dependencies'
	@awk '/^(llvmlite|numba|numpy|pyyaml|scipy)==/, !/\\$$/' $< > $@.txt
	@$(PIP) $(LOCKED) $@.txt
	@touch $@

$(VENV)/.runtime: requirements/runtime.txt $(VENV)/.compiler
	@$(PIP) $(LOCKED) $<
	@touch $@

# Editable: a change of the sources counts at once; installed again only when names or shared files change.
$(VENV)/.package: setup.py setup.cfg package.xml pyproject.toml $(SHARED) $(VENV)/.runtime
	@echo 'Installing flexmanip_ros'
	@$(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.warm: $(SOURCES) $(VENV)/.compiler
	@echo 'Compiling the kernels'
	@$(BIN)/python -m flexmanip_ros.cli.warm_up
	@touch $@

$(VENV)/.development: requirements/development.txt $(VENV)/.package
	@echo 'Installing the tools for tests'
	@$(PIP) $(LOCKED) $<
	@touch $@

$(VENV)/.benchmark: requirements/benchmark.txt $(VENV)/.development
	@echo 'Installing the peers for benchmarks'
	@$(PIP) $(LOCKED) $<
	@touch $@

demo: setup
	@$(BIN)/demo $(DEMO_ARGS)

# Four parts side by side, which take about as long as each other, so no core is idle in the end: nodes, which often
# wait, with controller, files, plant and golden results; programs and tools; the payload; and what else computes. Nodes
# go first, as their tests measure time.
NODES := test/ros test/control test/golden test/io test/plant
PROGRAMS := test/cli test/view test/studies test/paper test/packaging
PAYLOAD := test/payload
test: setup $(VENV)/.development
ifeq ($(strip $(PYTEST_ARGS)),)
	@mkdir -p log; status=0; \
	ROS_DOMAIN_ID=71 $(BIN)/python -m pytest $(NODES) > log/test_nodes.txt 2>&1 & nodes=$$!; \
	ROS_DOMAIN_ID=72 nice $(BIN)/python -m pytest $(PROGRAMS) > log/test_programs.txt 2>&1 & programs=$$!; \
	nice $(BIN)/python -m pytest $(PAYLOAD) > log/test_payload.txt 2>&1 & payload=$$!; \
	nice $(BIN)/python -m pytest test $(addprefix --ignore=,$(NODES) $(PROGRAMS) $(PAYLOAD)) || status=$$?; \
	wait $$payload || status=$$?; cat log/test_payload.txt; \
	wait $$programs || status=$$?; cat log/test_programs.txt; \
	wait $$nodes || status=$$?; cat log/test_nodes.txt; exit $$status
else
	@$(BIN)/python -m pytest $(PYTEST_ARGS)
endif

# The wheel in a fresh environment, every command of the first pages, and a colcon build with its kernels.
test-wheel: setup $(VENV)/.development
	@FLEXMANIP_FRESH=1 $(BIN)/python -m pytest -o faulthandler_timeout=2400 test/packaging

lint: $(VENV)/.development
	@$(BIN)/ruff check .
	@$(BIN)/mypy

bench: setup $(VENV)/.benchmark
	@$(BIN)/python benchmarks/run_all.py $(BENCH)

$(DOCS)/.ready: requirements/docs.txt
	@requirements/make_venv.sh $(DOCS)
	@echo 'Installing what builds the site'
	@$(DOCS)/bin/python $(QUIETLY) $(LOCKED) $<
	@touch $@

# A warning is an error: a link to a page or heading that is not there, a page that is in no contents.
docs: $(VENV)/.package $(DOCS)/.ready
	@$(BIN)/python docs/write_parameters.py
	@$(BIN)/python benchmarks/tables.py
	@$(BIN)/python docs/write_reference.py
	@$(DOCS)/bin/sphinx-build -W --keep-going --nitpicky --quiet -b html -d build/doctrees docs build/html
	@echo 'The site is in build/html/index.html'

$(JAZZY)/.ready: requirements/jazzy.txt setup.py setup.cfg package.xml pyproject.toml $(SHARED)
	@requirements/make_venv.sh $(JAZZY) 3.12
	@echo 'Installing the versions of Ubuntu 24.04'
	@$(JAZZY)/bin/python $(QUIETLY) $(LOCKED) $<
	@FLEXMANIP_WARM_UP=0 $(JAZZY)/bin/python $(QUIETLY) install --no-deps --no-build-isolation --editable .
	@touch $@

test-jazzy: $(JAZZY)/.ready
	@$(JAZZY)/bin/python -m flexmanip_ros.cli.warm_up
	@$(JAZZY)/bin/python -m pytest $(PYTEST_ARGS)

lock: $(VENV)/.python
	@$(PIP) install uv
	@PATH="$(CURDIR)/$(BIN):$$PATH" requirements/lock.sh

clean:
	rm -rf $(VENV) $(DOCS) $(JAZZY) build install log demo_output
