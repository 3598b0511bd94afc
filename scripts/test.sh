#!/usr/bin/env bash
# Makes the environment and runs all checks: style, types, tests, examples.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
make_environment dev

ruff check --output-format concise .
ruff format --check -q .
mypy
python -m pytest -n "${LIST3R_TEST_PROCESSES:-2}" "$@"
