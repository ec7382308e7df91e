# Creates the virtual environment .venv, installs the project into it with the pinned versions, and activates it. Other scripts source
# this file. Usage: source scripts/environment.sh EXTRA   (EXTRA is "", "[test]" or "[release]")

find_python() {
    local candidate
    for candidate in "${PYTHON:-python3}" python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    echo "Python 3.11 or newer is needed, but $(python3 --version 2>&1 || echo 'no python3') was found." \
        "Install it, or give its path: PYTHON=/path/to/python3.11 $0" >&2
    return 1
}

make_venv() {
    local python
    python=$(find_python) || return 1
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        echo "$python cannot create virtual environments. On Debian and Ubuntu, install the module: sudo apt install" \
            "python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv" >&2
        return 1
    fi
    echo "Creating a virtual environment in .venv ..."
    "$python" -m venv .venv
}

prepare() {
    local extra=$1 stamp wanted others
    [ -x .venv/bin/pip ] || make_venv || return 1
    # .venv/installed has a line for each installed extra: a hash of the files that list the dependencies, and the extra. An environment
    # with the extra [test] is sufficient for the extra ""
    wanted="$(cat pyproject.toml constraints.txt | sha256sum | cut -d' ' -f1)"
    stamp=.venv/installed
    unset PYTHONDONTWRITEBYTECODE # with this variable, each process would compile all modules again
    if ! grep -qxF -e "$wanted$extra" -e "$wanted${extra:-[test]}" "$stamp" 2>/dev/null; then
        echo "Installing the project and its dependencies into .venv (a few minutes the first time) ..."
        .venv/bin/python -m pip install -qq --no-compile --disable-pip-version-check -c constraints.txt -e ".$extra" || return 1
        others=$(grep -F "$wanted" "$stamp" 2>/dev/null) || true
        printf '%s\n' "$wanted$extra" $others >"$stamp"
    fi
    export PATH="$PWD/.venv/bin:$PATH"
}

prepare "$1"
