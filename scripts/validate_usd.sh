#!/bin/sh
# NVIDIA's validator of OpenUSD over exported files, in an environment of its own: it pins packages that the rest must not
# take. `scripts/validate_usd.sh FILE.usdc ...`; status 1 where it finds something.
set -eu
env=.venv-usd
[ -x "$env/bin/nvidia_usd_validate" ] || {
    python3 -m venv "$env"
    "$env/bin/pip" install -q "usd-core>=26.5" "usd-validation-nvidia>=1.22"
}
# Each file alone in a folder: one rule is about what lies beside it.
for file in "$@"; do
    folder=$(mktemp -d)
    cp "$file" "$folder"
    "$env/bin/nvidia_usd_validate" "$folder/$(basename "$file")" || exit 1
    rm -r "$folder"
done
