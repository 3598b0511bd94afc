#!/bin/sh
# NVIDIA's validators of OpenUSD, each in an environment of its own: they pin packages that the rest must not take, and
# the rules for robots that come with the second would be asked of every file by the first.
#
#     scripts/validate_usd.sh FILE.usdc ...      nvidia_usd_validate for each file
#     scripts/validate_usd.sh FOLDER             of `export --to simready`: its scene, and every prop by Robotics-Prop 4.0.0
#
# Status 1 where one finds something. PYTHON is 3.11 or 3.12 (python3 unless told).
set -eu
usd=${LIST3R_USD_VENV:-.venv-usd}
simready=${LIST3R_SIMREADY_VENV:-.venv-simready}

environment() {
    [ -x "$1/bin/$2" ] && return
    "${PYTHON:-python3}" -m venv "$1"
    shift 2
    "$folder/bin/pip" install -q "$@"
}

props() {
    folder=$simready
    environment "$simready" simready-validate "simready-validate>=2026.8" "simready-foundation-tier-core>=2026.8"
    work=$(mktemp -d)
    find "$1" -path '*/simready_usd/*.usd' | sort > "$work/list"
    "$simready/bin/simready-validate" --profile Robotics-Prop --version 4.0.0 --asset_list "$work/list" \
        --output "$work/told.json" > "$work/told" 2>&1 || true
    all=$(wc -l < "$work/list") passed=$(grep -c '\[PASSED\] Robotics-Prop' "$work/told" || true)
    echo "$passed of $all props pass Robotics-Prop 4.0.0"
    [ "$all" -gt 0 ] || { echo "error: $1 holds no props; give the folder of \`export --to simready\`" >&2; exit 1; }
    [ "$passed" -eq "$all" ] || { grep -B1 -A2 '\[FAILED\]' "$work/told"; exit 1; }
    rm -r "$work"
}

for path in "$@"; do
    folder=$usd
    environment "$usd" nvidia_usd_validate "usd-core>=26.5" "usd-validation-nvidia>=1.22"
    if [ -d "$path" ]; then
        "$usd/bin/nvidia_usd_validate" "$path/scene.usdc" || exit 1
        props "$path"
        continue
    fi
    # Each file alone in a folder: one rule is about what lies beside it.
    work=$(mktemp -d)
    cp "$path" "$work"
    "$usd/bin/nvidia_usd_validate" "$work/$(basename "$path")" || exit 1
    rm -r "$work"
done
