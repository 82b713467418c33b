# SPDX-License-Identifier: BSD-3-Clause
# `make demo` and `make test` first create a virtual environment in the checkout. They change nothing outside of it.
PYTHON ?= python3
BIN := .venv/bin
NATIVE := $(shell find camera_node/native fusion/native -name '*.[ch]pp')
CORES := $(shell find camera_node/native fusion/native -name '*.cpp' ! -name 'bind*')

.PHONY: demo test check docs setup format clean

demo: .venv/ready
	@$(BIN)/python -m web --demo $(ARGS)

test: .venv/ready
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadgroup --no-loadscope-reorder $(ARGS)

check: .venv/ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/clang-format --dry-run --Werror $(NATIVE)
	@command -v clang++ >/dev/null || echo "clang++ is not installed: its warnings are not checked"
	@! command -v clang++ >/dev/null || printf '%s\n' $(CORES) | xargs -P 4 -I FILE clang++ -fsyntax-only -std=c++20 \
	  -Werror -Wall -Wextra -Wpedantic -Wshadow -Wcomma -Icamera_node/native -Ifusion/native FILE
	$(BIN)/lint-imports
	$(BIN)/basedpyright

docs: .venv/ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "open build/site/index.html"

format: .venv/ready
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(BIN)/clang-format -i $(NATIVE)

setup: .venv/ready

# Without build isolation, so that this build and the wheel's test compile changed files only.
.venv/ready: pyproject.toml CMakeLists.txt $(NATIVE)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "error: $(PYTHON) is older than Python 3.11; run make with PYTHON=/path/to/python3.11" >&2; exit 2; }
	@$(PYTHON) -m venv .venv
	@echo "setting up .venv (a few minutes the first time)"
	@$(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")' \
	  | $(BIN)/python -m pip install --quiet --disable-pip-version-check -r /dev/stdin
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -e '.[server,dev]'
	@touch $@

clean:
	rm -rf .venv build
