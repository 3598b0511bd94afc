#!/usr/bin/env bash
# Makes the environment and builds the documentation site into out/site; a broken link or reference is an error.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
make_environment docs

rm -rf out/docs
mkdir -p out
cp -rL docs out/docs
python scripts/reference_pages.py out/docs
exec python -m mkdocs build --strict
