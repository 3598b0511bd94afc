# Sourced by the other scripts: makes .venv with what they need and puts it first on PATH.
# Called with the extras to install, such as "build,export" or "dev". A second call starts in well under a second.
make_environment() {
    extras="$1"
    root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
    venv="${LIST3R_VENV:-$root/.venv}"
    wanted="$(cat "$root/pyproject.toml" "$root/scripts/environment.sh" | cksum | cut -d' ' -f1)"
    stamp="$venv/.list3r-$extras-$wanted"
    export PATH="$venv/bin:$PATH"
    cd "$root"
    [ -e "$stamp" ] && return 0

    python="$(find_python)" || { echo "error: Python 3.11 or newer is needed; install python3.11 and python3.11-venv" >&2; exit 2; }
    install_system_libraries
    if [ ! -x "$venv/bin/python" ]; then
        echo "making the environment $venv" >&2
        "$python" -m venv "$venv" 2>/dev/null || {
            as_root apt-get install -y -q "$(basename "$python")-venv" >/dev/null && rm -rf "$venv" && "$python" -m venv "$venv"
        } || { echo "error: $python has no venv module; install python3-venv" >&2; exit 2; }
    fi
    echo "installing packages (a few minutes the first time)" >&2
    constraints="$(mktemp)"
    echo "torch==2.13.0" > "$constraints"
    # PyTorch first and under a constraint, so that no other package brings a second build of it.
    case ",$extras," in *,all,* | *,dev,* | *,colour,*)
        "$venv/bin/python" -m pip install -q --disable-pip-version-check -c "$constraints" torch==2.13.0 ;;
    esac
    "$venv/bin/python" -m pip install -q --disable-pip-version-check -c "$constraints" -e ".${extras:+[$extras]}"
    rm -f "$constraints"
    rm -f "$venv"/.list3r-"$extras"-*
    touch "$stamp"
}

find_python() {
    for candidate in python3.11 python3.12 python3.13 python3; do
        if command -v "$candidate" >/dev/null && "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
            command -v "$candidate"
            return 0
        fi
    done
    return 1
}

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then sudo "$@"; else return 1; fi
}

# Open3D, used for comparisons only, loads these; the main path does without them.
install_system_libraries() {
    command -v apt-get >/dev/null || return 0
    missing=""
    for package in libgl1 libegl1 libgomp1 libusb-1.0-0 libx11-6; do
        dpkg -s "$package" >/dev/null 2>&1 || missing="$missing $package"
    done
    [ -z "$missing" ] && return 0
    # shellcheck disable=SC2086
    { as_root apt-get update -q && as_root apt-get install -y -q --no-install-recommends $missing; } >/dev/null 2>&1 \
        || echo "note: the system libraries$missing could not be installed; only comparisons with Open3D need them" >&2
}
