# Every target makes its environment first: .venv with pinned packages, once.
VENV ?= .venv
VENV_OLDEST ?= .venv-oldest
ANSER = $(VENV)/bin/anser
READY = $(VENV)/.installed-newest
READY_DEMO = $(VENV)/.installed-demo
READY_OLDEST = $(VENV_OLDEST)/.installed-oldest
# One thread each: two cores are shared with the processes under test.
# Compiled bytecode is kept, as every process under test would compile all modules again.
ENVIRONMENT = OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=
# Three processes run the tests, as test/conftest.py shares them out: on two cores one calculates
# while two mostly wait for nodes. ARGS='-n 0' has one alone.
COUNT = 3
WORKERS = -n $(COUNT) --dist loadgroup --no-loadscope-reorder
ARGS ?=
# What the installation is made of: a new command or version installs anew.
PACKAGING = setup.py package.xml anser_ros/cli/commands.py

.DEFAULT_GOAL := help
.PHONY: help demo test test-core test-quick test-oldest lint format types parameters bags bench browser chaos soak paper loop measured docs clean

help:
	@echo 'make demo [DURATION=30]  watch a simulated tool being tracked'
	@echo 'make test                lint, types, tests'
	@echo 'make test-core           the same without the tests of the applications'
	@echo 'make test-quick          all without the tests that start processes or take long'
	@echo 'make test-oldest         tests with the oldest dependencies (needs Python 3.12)'
	@echo 'make bench               speed and accuracy beside rivals, writes bench.json'
	@echo 'make browser             the live view in a headless Chromium: closes the loop by clicking alone'
	@echo 'make chaos               faults on the running nodes, with exact truth; ARGS=--list names them'
	@echo 'make soak DURATION=3600  growth of memory, files, threads and latency of every node'
	@echo 'make docs                the documentation as a site, out/docs/index.html'
	@echo 'make paper|loop|measured the studies; options with ARGS=...'

# What the nodes and commands need; what all else needs is installed on top of it.
$(READY_DEMO): .ci/requirements-newest.txt .ci/requirements-oldest.txt .ci/bootstrap $(PACKAGING)
	@.ci/bootstrap $(VENV) demo
	@touch $@

$(READY): .ci/requirements-newest.txt .ci/requirements-development.txt .ci/requirements-oldest.txt .ci/bootstrap $(PACKAGING)
	@.ci/bootstrap $(VENV) newest
	@touch $@ $(READY_DEMO)

$(READY_OLDEST): .ci/requirements-oldest.txt .ci/bootstrap $(PACKAGING)
	@.ci/bootstrap $(VENV_OLDEST) oldest
	@touch $@

# The live view in a browser is an option with packages of its own.
demo: $(if $(findstring dashboard,$(ARGS)),$(READY),$(READY_DEMO))
	@$(VENV)/bin/python .ci/foreground $(ANSER) demo $(if $(DURATION),--duration $(DURATION)) $(ARGS)

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

format: $(READY)
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

# numpy's own types differ between its versions: they are checked with the pinned newest one.
types: $(READY)
	@if [ -e $(VENV)/requirements-beside-ros.txt ]; then \
		echo 'types: not checked beside a sourced ROS, whose numpy is older'; \
	else $(VENV)/bin/mypy; fi

bags: $(READY)
	@$(VENV)/bin/python .ci/write_bags.py

parameters: $(READY)
	@$(VENV)/bin/python .ci/write_parameters.py

# The types are checked beside the tests. Their words come when the tests have had the last line,
# and only if something is wrong.
test: lint
	@types=$$(mktemp); trap 'rm -f $$types' EXIT; \
	nice $(MAKE) --no-print-directory types >$$types 2>&1 & checked=$$!; \
	$(ENVIRONMENT) $(VENV)/bin/python -m pytest $(WORKERS) $(QUICK) $(ARGS); passed=$$?; \
	wait $$checked || { cat $$types; exit 1; }; \
	exit $$passed

test-quick: QUICK = -m 'not processes and not long'
test-quick: COUNT = 2
test-quick: test

test-core: QUICK = --ignore=test/apps
test-core: test

test-oldest: $(READY_OLDEST)
	$(ENVIRONMENT) $(VENV_OLDEST)/bin/python -m pytest $(WORKERS) $(ARGS)

bench: $(READY)
	@$(ENVIRONMENT) $(VENV)/bin/python test/bench/run.py $(ARGS)

browser: $(READY)
	@$(ENVIRONMENT) $(VENV)/bin/python test/browser/run.py $(ARGS)

chaos: $(READY)
	@$(ENVIRONMENT) $(VENV)/bin/python test/chaos/run.py $(ARGS)

soak: $(READY)
	@$(ENVIRONMENT) $(VENV)/bin/python test/chaos/soak.py $(if $(DURATION),--duration $(DURATION)) $(ARGS)

# -W: a warning is a fault; nothing is fetched from anywhere.
docs: $(READY)
	$(VENV)/bin/python -m sphinx -W --keep-going -q -b html docs out/docs
	@echo 'out/docs/index.html'

paper loop measured: $(READY)
	@$(ENVIRONMENT) $(ANSER) $@ $(ARGS)

clean:
	rm -rf build install log out *.egg-info .pytest_cache .mypy_cache .ruff_cache
