# SPDX-License-Identifier: BSD-3-Clause
# `make demo` and `make test` first create a virtual environment in the checkout. They change nothing outside of it.
PYTHON ?= python3
BIN := .venv/bin
NATIVE := $(shell find camera_node/native fusion/native -name '*.[ch]pp')
CORES := $(shell find camera_node/native fusion/native -name '*.cpp' ! -name 'bind*')

PIP = $(1)/bin/python -m pip install --quiet --disable-pip-version-check
TEST = OPENBLAS_NUM_THREADS=1 $(1)/bin/python -m pytest -n auto --dist loadgroup --no-loadscope-reorder --second-run $(2) $(ARGS)
# What builds the native modules, and what `pip install` would otherwise fetch for it.
BUILD_REQUIRES := $(PYTHON) -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], "cmake", "ninja", sep="\n")'

.PHONY: demo test check lint types docs setup constraints newest format clean

demo: .venv/ready
	@$(BIN)/python -m web --demo $(ARGS)

test: .venv/ready
	$(call TEST,.venv,--durations 5)

check: lint types

lint: .venv/ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/clang-format --dry-run --Werror $(NATIVE)
	@command -v clang++ >/dev/null || echo "clang++ is not installed: its warnings are not checked"
	@! command -v clang++ >/dev/null || printf '%s\n' $(CORES) | xargs -P 4 -I FILE clang++ -fsyntax-only -std=c++20 \
	  -Werror -Wall -Wextra -Wpedantic -Wshadow -Wcomma -Icamera_node/native -Ifusion/native FILE
	$(BIN)/lint-imports
	@! command -v go >/dev/null || $(MAKE) --no-print-directory build/bin/actionlint
	@[ ! -x build/bin/actionlint ] || build/bin/actionlint
	@[ -x build/bin/actionlint ] || echo "Go is not installed: the workflows are not checked"

types: .venv/ready
	$(BIN)/basedpyright

# The workflows' checker: its wheel would download a program that no registry has. Without access to Go's modules it is missed.
build/bin/actionlint:
	@mkdir -p $(@D)
	@GOBIN=$(CURDIR)/$(@D) timeout 300 go install github.com/rhysd/actionlint/cmd/actionlint@v1.7.12 2>/dev/null || true

docs: .venv/ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "open build/site/index.html"

format: .venv/ready
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(BIN)/clang-format -i $(NATIVE)

setup: .venv/ready

# Without build isolation, so that this build and the wheel's test compile changed files only.
.venv/ready: constraints.txt pyproject.toml CMakeLists.txt $(NATIVE)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "error: $(PYTHON) does not run, or is older than Python 3.11; run make with PYTHON=/path/to/python3.11" >&2; exit 2; }
	@$(PYTHON) -m venv .venv
	@echo "setting up .venv (a few minutes the first time)"
	@$(BUILD_REQUIRES) | $(call PIP,.venv) -c constraints.txt -r /dev/stdin
	@PATH="$(CURDIR)/.venv/bin:$$PATH" $(call PIP,.venv) -c constraints.txt --no-build-isolation -e '.[server,dev]'
	@touch $@

# The newest versions that pyproject.toml allows, for each Python from 3.11 on: CONTRIBUTING.md.
constraints:
	@$(PYTHON) -m venv --clear build/resolver
	@$(call PIP,build/resolver) uv
	@$(BUILD_REQUIRES) > build/resolver/build.in
	@{ echo "# Versions of every package that the demo, the tests and CI install. Made by \`make constraints\`."; \
	  build/resolver/bin/uv pip compile --quiet --upgrade --universal --python-version 3.11 --no-header --no-annotate \
	    --extra server --extra dev --extra benchmarks --extra rerun pyproject.toml build/resolver/build.in; } > build/resolver/constraints.txt
	@mv build/resolver/constraints.txt constraints.txt
	@git --no-pager diff --stat constraints.txt

# The suite with the newest versions that pyproject.toml allows, whatever constraints.txt says; writes only below build/.
newest:
	@$(PYTHON) -m venv --clear build/newest
	@$(BUILD_REQUIRES) | $(call PIP,build/newest) --upgrade -r /dev/stdin
	@PATH="$(CURDIR)/build/newest/bin:$$PATH" $(call PIP,build/newest) --upgrade --no-build-isolation \
	  --config-settings build-dir=build/newest/native -e '.[server,dev]'
	@build/newest/bin/python -m pip freeze --exclude-editable > build/newest/versions.txt
	$(call TEST,build/newest,-m 'not slow')

clean:
	rm -rf .venv build
