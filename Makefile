# Everything happens in .venv, which is made when it is first needed. Where a ROS 2 installation is sourced, its rclpy is
# used, and the system's numpy, against which its messages were built; elsewhere rclpy comes from PyPI.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP ?= $(BIN)/python -m pip --disable-pip-version-check
DEMO := bags/demo
PROSE := README.md CONTRIBUTING.md SECURITY.md QUALITY_DECLARATION.md CHANGELOG.md $(filter-out docs/style.md,$(wildcard docs/*.md docs/*/*.md))

# Many tests wait, for processes to start and for DDS, so cores have time for more of them.
WORKERS ?= $(shell $(PYTHON) -c 'import os; print(2 * len(os.sched_getaffinity(0)))')

HAVE_ROS := $(shell $(PYTHON) -c 'import rclpy' 2>/dev/null && echo yes)
comma := ,

export PYTEST_DISABLE_PLUGIN_AUTOLOAD = 1

# The tests start hundreds of processes. Without byte code on disk, each would compile every module of numba again: 3 s.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test coverage bench growth fuzz torture dist lowest pythons docs site images sample clean

demo: $(VENV)/run.stamp ## the paper's scenario with outages: run, record, analyse
	rm -rf $(DEMO)
	$(BIN)/agv-ncs run config/outages.yaml --bag $(DEMO)
	$(BIN)/agv-ncs analyse $(DEMO) --json $(DEMO)/analysis.json --report $(DEMO)/report.html

test: $(VENV)/test.stamp ## style, types, prose and tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/proselint --config .proselintrc.json check $(PROSE)
	@# mypy has one core, and takes its time: beside the tests, that wait now and then. It speaks at the end.
	$(BIN)/mypy >$(VENV)/mypy.log 2>&1 & types=$$!; \
	$(BIN)/python -m pytest -p pytest_cov -p xdist -p hypothesis.extra.pytestplugin -n $(WORKERS) --dist worksteal $(PYTEST_ARGS); \
	tests=$$?; wait $$types; types=$$?; cat $(VENV)/mypy.log; exit $$((tests ? tests : types))

coverage: PYTEST_ARGS += --cov --cov-report=term ## the same with coverage, which takes longer
coverage: test

bench: $(VENV)/test.stamp ## speed, as ratios to peers measured in the same run; JSON=FILE keeps it, AGAINST=FILE compares
	$(BIN)/python -m benchmarks $(BENCH) $(if $(JSON),--json $(JSON)) $(if $(AGAINST),--against $(AGAINST))

growth: $(VENV)/test.stamp ## cost and memory against steps, vehicles, seeds, states and size of bags: docs/performance.md
	$(BIN)/python -m benchmarks.growth

fuzz: $(VENV)/test.stamp ## damaged bags against independent readers, a million over night; CASES=1000 for fewer
	nice $(BIN)/python -m fuzz --cases $(or $(CASES),1000000) --json fuzz.json --save fuzz_failures

torture: $(VENV)/test.stamp ## signals to every process of a run, wild messages, damaged bags; MINUTES=20
	$(BIN)/python -m torture --minutes $(or $(MINUTES),20) --json torture.json

dist: $(VENV)/test.stamp ## source archive and wheel of the newest commit, checked and tried, in dist/
	$(BIN)/python -m release

lowest: $(VENV)/test.stamp ## the cheap tests with the lowest versions of packages that setup.py allows
	$(BIN)/python -m release.environments lowest-direct 3.10

pythons: $(VENV)/test.stamp ## the cheap tests with each version of Python that can be had; PYTHONS=3.12 for one
	$(BIN)/python -m release.environments highest $(or $(PYTHONS),3.10 3.11 3.12 3.13 3.14)

docs: $(VENV)/run.stamp ## bring README.md and docs/ up to date with the code
	$(BIN)/python docs/update.py

site: docs $(VENV)/site.stamp ## the docs as a site for the browser, build/site/index.html, whose search needs no server
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet -d build/site-cache docs build/site

images: $(VENV)/test.stamp ## draw the pages in headless Chromium to docs/images
	$(BIN)/python docs/screenshots.py

sample: $(VENV)/run.stamp ## make the sample bag anew
	rm -rf bags/sample
	$(BIN)/agv-ncs run config/outages.yaml --bag bags/sample --duration 10

clean:
	rm -rf $(VENV) $(DEMO) build install log *.egg-info

$(VENV)/bin/python:
	$(PYTHON) -m venv $(if $(HAVE_ROS),--system-site-packages) $(VENV)

$(VENV)/run.stamp: $(VENV)/bin/python setup.py
	$(PIP) install --quiet --editable '.[all$(if $(HAVE_ROS),,$(comma)ros)]'
	touch $@

$(VENV)/test.stamp: $(VENV)/bin/python setup.py
	$(PIP) install --quiet --editable '.[test$(if $(HAVE_ROS),,$(comma)ros)]'
	touch $@ $(VENV)/run.stamp

$(VENV)/site.stamp: $(VENV)/run.stamp
	$(PIP) install --quiet --editable '.[site]'
	touch $@
