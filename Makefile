# `make build`, `make demo` and `make test` need Python 3.10 or later, pip and a C++ compiler; what
# else they need goes into .venv. `make help` lists the targets.

PYTHON ?= python3
# pip's arguments for torch, so a wheel's path and options are welcome here.
TORCH ?= torch==2.13.0
PYTEST_ARGS ?= -n 2
BENCH_ARGS ?=
GPU_TESTS ?= tests/test_gpu*.py tests/test_triton*.py tests/test_cuda_ops.py \
tests/test_benchmarks_gpu.py tests/test_metrics.py::test_on_cuda tests/test_d4_inputs.py::test_cuda

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check
BUILD_NEEDS := $(shell sed -n 's/^requires = \[\(.*\)\]$$/\1/p' pyproject.toml | tr ',' ' ')
# Its name holds the request, so that asking for another torch installs it.
TORCH_STAMP := $(VENV)/.torch-$(shell echo '$(TORCH)' | cksum | cut -d ' ' -f 1)
CXX_FILES = $(shell find csrc tests/native -name '*.cpp' -o -name '*.h' -o -name '*.inl' 2>/dev/null)

ifneq ($(wildcard ../shared/data),)
export SURFCONV_DATA ?= $(abspath ../shared/data)
endif

# Two pip runs must never write to one environment; what is slow below is parallel in itself.
.NOTPARALLEL:
.PHONY: build demo test test-gpu lint format asan bench wheel clean distclean help

build: $(VENV)/.installed  ## create .venv where it is missing, install, compile what changed
	@$(PY) setup.py -q build_ext --inplace

demo: build $(VENV)/.examples  ## run SurfConv on a built-in scene and save a picture that explains it
	$(PY) examples/frame.py

test: build $(VENV)/.dev  ## run the tests
	$(PY) -m pytest $(PYTEST_ARGS)

# The same kernels that `make test` runs in Triton's interpreter, compiled, and what needs a device.
test-gpu: build $(VENV)/.dev  ## run the tests that need a CUDA device
	@$(PY) -c 'import torch; torch.cuda.init()'
	$(PY) -m pytest $(GPU_TESTS)

lint: $(VENV)/.dev  ## check style and types
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/clang-format --dry-run -Werror $(CXX_FILES)
	@echo "lint: clean"

format: $(VENV)/.dev  ## rewrite the sources in the project's style
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .
	$(VENV)/bin/clang-format -i $(CXX_FILES)

# Python links no libstdc++: without it preloaded AddressSanitizer cannot see a throw.
asan: build $(VENV)/.dev  ## run the core tests under AddressSanitizer and UBSan
	SURFCONV_SANITIZE=1 $(PY) setup.py -q build_ext --build-lib build/asan
	LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so) $$($(CXX) -print-file-name=libubsan.so) \
	$$($(CXX) -print-file-name=libstdc++.so)" \
	ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
	SURFCONV_SANITIZE=1 SURFCONV_LIBRARY=$(abspath build/asan/surfconv_ops/_C.so) \
	$(PY) -m pytest -m core $(PYTEST_ARGS)

bench: build $(VENV)/.examples  ## measure, beside nn.Conv2d
	$(PY) benchmarks/run.py $(BENCH_ARGS)

wheel: build  ## build dist/*.whl and try it in a clean environment without a compiler
	rm -rf build/lib* build/bdist* build/smoke dist
	$(PIP) -q wheel . --no-deps --no-build-isolation -w dist
	$(PY) -m venv --without-pip build/smoke
	$(PIP) -q --python build/smoke/bin/python install $(TORCH) dist/*.whl
	cd build/smoke && PATH=$(abspath build/smoke/bin) bin/python -I ../../scripts/wheel_smoke.py
	rm -rf build/smoke
	@ls -l dist/*.whl

clean:  ## remove what was built; distclean removes .venv too
	rm -rf build dist *.egg-info surfconv_ops/_C.so .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV)

help:
	@sed -n 's/^\([a-z-]*\):.*## /\1	/p' $(MAKEFILE_LIST)

# Systems that package Python apart from ensurepip still make an environment; the pip outside
# then fills it.
$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	echo "surfconv_ops needs Python 3.10 or later; name one with: make PYTHON=..." >&2; exit 1; }
	@test -x $(PY) || $(PYTHON) -m venv --without-pip $(VENV)
	@$(PY) -m pip --version >/dev/null 2>&1 || $(PY) -m ensurepip --default-pip >/dev/null 2>&1 || \
	$(PYTHON) -m pip --python $(PY) install -q pip || { \
	echo "$(VENV) has no pip: install Python's venv and ensurepip modules (on Debian and Ubuntu" \
	"the package python3-venv), or pip 22.3 or later, then run make again." >&2; exit 1; }
	@touch $@

$(TORCH_STAMP): $(VENV)/.created
	@rm -f $(VENV)/.torch-*
	$(PIP) -q install $(TORCH) $(BUILD_NEEDS)
	@touch $@

# Compiling ahead of pip, which would do it unseen.
$(VENV)/.installed: $(TORCH_STAMP) setup.py pyproject.toml
	$(PY) setup.py -q build_ext --inplace
	$(PIP) -q install --no-build-isolation -e .
	@touch $@

$(VENV)/.examples: $(VENV)/.installed
	$(PIP) -q install --no-build-isolation -e '.[examples]'
	@touch $@

$(VENV)/.dev: $(VENV)/.installed
	$(PIP) -q install --no-build-isolation -e '.[dev]'
	@touch $@
