# Targets that need the environment install it first (scripts/setup); if it is up to date, that takes milliseconds.

.DEFAULT_GOAL := help
.PHONY: help setup test test-long test-matrix torture check format demo bench docs lock vendor sbom audit tower tower-secrets unitree clean

PYTEST_ARGS ?=
BENCH_ARGS ?=
TOWER_ARGS ?=
# Installs what the demo and a server need, or all packages where these are installed.
SMALL_SETUP = @PYTHON="$(PYTHON)" scripts/setup demo

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 15

setup: ## install the environment of tests and checks (.venv, go2_interfaces); PYTHON=... names the interpreter
	@PYTHON="$(PYTHON)" scripts/setup

unitree: setup ## build unitree_go, the messages of a Unitree robot's own topics, into the environment; a few minutes, once
	scripts/unitree

test: setup ## run all tests but the long ones; PYTEST_ARGS="-k spool -x" is passed to pytest
	PYTHONDONTWRITEBYTECODE= scripts/with-env pytest -n auto --no-loadscope-reorder $(PYTEST_ARGS)

test-long: setup ## run the tests that take minutes: kills, full disks, the demo, servers
	PYTHONDONTWRITEBYTECODE= SHADOWHOUND_TEST_LONG=1 scripts/with-env pytest -n auto --no-loadscope-reorder -m long $(PYTEST_ARGS)

test-matrix: ## run all tests on other Pythons, numpys and ROS distributions; CELLS=... selects some
	@PYTEST_ARGS="$(PYTEST_ARGS)" scripts/test-matrix $(CELLS)

torture: setup ## campaigns of faults, kills, full disks, damaged files, hostile input and long outages; TORTURE_ARGS=--short is shorter
	scripts/with-env python -m torture $(TORTURE_ARGS)

check: setup ## lint, format and types
	scripts/with-env ruff check .
	scripts/with-env ruff format --check .
	scripts/with-env mypy

format: setup ## fix and format what ruff can
	scripts/with-env ruff check --fix .
	scripts/with-env ruff format .

demo: ## a simulated Go2, a server and one patrol mission, 90 seconds; DEMO_ARGS=--keep keeps the live page running
	$(SMALL_SETUP)
	scripts/with-env python -m shadowhound_sim.demo $(DEMO_ARGS)

bench: setup ## benchmarks against the baseline, as ratios, into docs/evidence/benchmarks.md; BENCH_ARGS=--quick is shorter
	scripts/with-env python bench/run.py $(BENCH_ARGS)

docs: ## write docs/parameters.md and docs/commands.md from the code, and build the documentation site into build/site
	$(SMALL_SETUP)
	scripts/docs

lock: setup ## update requirements/*.txt from requirements/*.in; LOCK_ARGS=--upgrade also updates the pins
	scripts/lock $(LOCK_ARGS)

vendor: ## bundle the libraries of the live page (three, uPlot, preact) from npm
	scripts/vendor

sbom: setup ## bills of materials (CycloneDX) of the lock files and of the bundled libraries, into build/sbom
	scripts/with-env python requirements/supply_chain.py sbom

audit: setup ## known vulnerabilities of the pinned packages; skipped if their database cannot be reached
	scripts/with-env python requirements/supply_chain.py audit

tower-secrets: ## credentials of a server, once; TOWER_ARGS="--host 192.168.1.10 --robot rover" is passed to tower/make_secrets.py
	python3 tower/make_secrets.py $(TOWER_ARGS)

tower: ## a server without Docker (SeaweedFS, PostgreSQL or SQLite, MLflow), until it is interrupted
	$(SMALL_SETUP)
	scripts/with-env python tower/run.py $(TOWER_ARGS)

clean: ## remove the environment and everything that was built
	rm -rf .venv .cache build install log demo .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
