# Every target makes the environment first (see scripts/setup); with nothing to do that takes milliseconds.

.DEFAULT_GOAL := help
.PHONY: help setup test test-long test-matrix torture check format demo bench docs lock vendor sbom audit tower tower-secrets unitree clean

PYTEST_ARGS ?=
BENCH_ARGS ?=
TOWER_ARGS ?=

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 15

setup: ## make the environment (.venv, go2_interfaces); PYTHON=... names the interpreter
	@PYTHON="$(PYTHON)" scripts/setup

unitree: setup ## build unitree_go, the messages of a Unitree robot's own topics, into the environment: some minutes, once
	scripts/unitree

test: setup ## run all tests; PYTEST_ARGS="-k spool -x" is handed on
	PYTHONDONTWRITEBYTECODE= scripts/with-env pytest -n auto --no-loadscope-reorder $(PYTEST_ARGS)

test-long: setup ## run the tests that take minutes: kills, full disks, the demo, Towers
	PYTHONDONTWRITEBYTECODE= SHADOWHOUND_TEST_LONG=1 scripts/with-env pytest -n auto --no-loadscope-reorder -m long $(PYTEST_ARGS)

test-matrix: ## run all tests on other Pythons, numpys and ROS distributions; CELLS=... names some
	@PYTEST_ARGS="$(PYTEST_ARGS)" scripts/test-matrix $(CELLS)

torture: setup ## campaigns of faults, kills, full disks, rot, hostile input and long outages; TORTURE_ARGS=--short is shorter
	scripts/with-env python -m torture $(TORTURE_ARGS)

check: setup ## lint, format and types
	scripts/with-env ruff check .
	scripts/with-env ruff format --check .
	scripts/with-env mypy

format: setup ## let ruff repair and format what it can
	scripts/with-env ruff check --fix .
	scripts/with-env ruff format .

demo: setup ## a simulated Go2, an embedded Tower and one patrol mission, a minute and a half; DEMO_ARGS=--keep keeps its live page
	scripts/with-env python -m shadowhound_sim.demo $(DEMO_ARGS)

bench: setup ## benchmarks against the baseline, as ratios, into docs/evidence/benchmarks.md; BENCH_ARGS=--quick is shorter
	scripts/with-env python bench/run.py $(BENCH_ARGS)

docs: setup ## write docs/parameters.md and docs/commands.md from the code, and build the documentation site into build/site
	scripts/docs

lock: setup ## write requirements/*.txt anew from requirements/*.in; LOCK_ARGS=--upgrade renews the pins
	scripts/lock $(LOCK_ARGS)

vendor: ## bundle what the live page needs of others (three, uPlot, preact) from npm
	scripts/vendor

sbom: setup ## bills of materials (CycloneDX) of the lock files and of what is vendored, into build/sbom
	scripts/with-env python requirements/supply_chain.py sbom

audit: setup ## known vulnerabilities of what the lock files pin; skipped where their database cannot be reached
	scripts/with-env python requirements/supply_chain.py audit

tower-secrets: ## credentials of a Tower, once; TOWER_ARGS="--host 192.168.1.10 --robot thor" is handed on
	python3 tower/make_secrets.py $(TOWER_ARGS)

tower: setup ## a Tower without Docker (SeaweedFS, PostgreSQL or SQLite, MLflow), until it is interrupted
	scripts/with-env python tower/run.py $(TOWER_ARGS)

clean: ## remove the environment and everything that was built
	rm -rf .venv .cache build install log demo .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
