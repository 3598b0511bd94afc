#!/usr/bin/env bash
# Makes the environment and runs all checks: style, types, tests, examples. The slow tests run with --all.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
make_environment dev

chosen=(-m "not slow")
if [ "${1:-}" = --all ]; then chosen=(); shift; fi

ruff check --output-format concise .
ruff format --check -q .
mypy
processes="${LIST3R_TEST_PROCESSES:-2}"
# Each process with its share of the cores: threads that wait for each other take three times as long.
threads=$(($(nproc) / processes))
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-$((threads > 1 ? threads : 1))}"
export OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-$OMP_NUM_THREADS}"
# Compiled modules are kept, so that the hundreds of processes that tests start need not compile them again. Each process
# of the suite takes a run of neighbouring tests, so that few fixtures of a file are made twice.
unset PYTHONDONTWRITEBYTECODE
python -m pytest -n "$processes" --dist worksteal "${chosen[@]}" "$@"
