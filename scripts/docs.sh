#!/bin/sh
# Builds the documentation site into out/site; a broken link or reference is an error. Needs `pip install '.[docs]'`.
set -eu
cd "$(dirname "$0")/.."
rm -rf out/docs
mkdir -p out
cp -rL docs out/docs
python scripts/reference_pages.py out/docs
exec python -m mkdocs build --strict
