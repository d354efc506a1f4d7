# Needs Python 3.10 or newer and make; everything else goes into .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
UV     ?= $(shell command -v uv)
BIN    := .venv/bin
READY  := .venv/.ready

.PHONY: setup demo test coverage slow peers compat bench docs lint lock clean
setup: $(READY)

$(READY): requirements.lock pyproject.toml
	@rm -rf .venv
	@$(PYTHON) -m venv .venv
	@if [ -n "$(UV)" ] && $(UV) pip sync -qq --require-hashes --python $(BIN)/python requirements.lock; then :; \
	else $(BIN)/python -m pip install -qq --disable-pip-version-check --require-hashes -r requirements.lock; fi
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: setup
	@$(BIN)/lumidock demo --force

test: lint
	@$(BIN)/lumidock warm  # or every worker would compile the same
	@$(BIN)/python -m pytest -n auto --dist loadfile

# the same tests, and which lines they reach
coverage: setup
	@$(BIN)/python -m pytest -n auto --dist loadfile --cov --cov-report=term

slow: setup
	@$(BIN)/python -m pytest -m slow

# clients that others wrote; those of Debian are in tests/peers/README
peers: setup
	@npm install --silent --no-audit --no-fund --no-package-lock --prefix .peers @mcap/core @mcap/nodejs @mcap/support \
	  @foxglove/rosmsg @foxglove/rosmsg2-serialization @foxglove/ws-protocol ws node-mavlink || true
	@test -x .peers/evo/bin/evo_ape || { $(PYTHON) -m venv .peers/evo && .peers/evo/bin/python -m pip install -qq evo; } || true
	@$(BIN)/python -m pytest -m peers -rs

# before a release: the wheel, the lowest and the newest versions, every Python at hand; some ten minutes for each
compat: setup
	@$(BIN)/python tests/compat.py

docs: setup
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

lint: setup
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

bench: setup
	@$(BIN)/python -m bench

lock:
	@$(UV) pip compile pyproject.toml --quiet --all-extras --group dev --generate-hashes --universal --python-version 3.10 \
	  --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" -o requirements.lock

clean:
	@rm -rf .venv demo-out bench-out site
