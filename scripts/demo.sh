#!/usr/bin/env bash
# Makes the environment and runs the main job: scripts/demo.sh [SOURCE [OPTIONS OF list3r build]]
# Without SOURCE: a simulated walk through two rooms. Results go to out/.
set -euo pipefail
source="${1:-}"
[ -z "$source" ] || { shift; [ ! -e "$source" ] || source="$(realpath "$source")"; }
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
# The simulated walk has depth: it takes no PyTorch, which is several GB.
make_environment "$([ -n "$source" ] && echo all || echo build,export,view)"
out="${LIST3R_OUT:-out}"

use_it() { echo; echo "To use the program in this shell: source $venv/bin/activate"; }

if [ -z "$source" ]; then
    list3r demo --out "$out/demo"
    use_it
    echo "To look at the memory in the browser: list3r view $out/demo/rooms.l3r"
    exit 0
fi

mkdir -p "$out"
memory="$out/$(basename "${source%.*}").l3r"
run() { echo; echo "\$ list3r $*"; list3r "$@"; }
run inspect "$source"
if [ -e "$memory" ]; then again=--resume; else again=; fi
run build "$source" -m "$memory" $again "$@"
run list "$memory"
run relations "$memory" --predicate on
run nearest "$memory" --point 0,0,0 -k 5
for format in json usd plan glb ply tum; do
    case $format in usd) suffix=usda ;; plan) suffix=png ;; tum) suffix=txt ;; *) suffix=$format ;; esac
    run export "$memory" --to $format --out "${memory%.l3r}.$suffix"
done
echo
echo "The picture to look at: ${memory%.l3r}.png"
use_it
