# shellcheck shell=bash
# Sourced by the other scripts: makes .venv on first use, or anew where its requirements changed,
# and defines `project_root`, `venv_python` and `step`. Keeps to bash 3.2, which macOS ships.

project_root=$(CDPATH='' cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
venv_python="$project_root/.venv/bin/python"

# step DESCRIPTION COMMAND...: runs the command between a line that announces it and its seconds.
step() {
    local description=$1 start=$SECONDS
    shift
    printf '== %s ...\n' "$description"
    "$@"
    printf '== done in %d s\n' "$((SECONDS - start))"
}

# Prints a Python 3.11 to 3.13; one that PYTHON names is taken or refused, never replaced.
find_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
        if "$candidate" -c 'import ensurepip, sys, venv
sys.exit(not (3, 11) <= sys.version_info < (3, 14))' >/dev/null 2>&1; then
            printf '%s\n' "$candidate"
            return
        fi
    done
    printf 'error: %s is no Python 3.11, 3.12 or 3.13 with venv: install one (Debian, Ubuntu: %s)\n' \
        "${PYTHON:-python3}" "also python3-venv), or name it with PYTHON=/path/to/python3.12" >&2
    exit 2
}

# Twice quiet: errors only.
pip_install() {
    "$venv_python" -m pip install --quiet --quiet --no-input --disable-pip-version-check "$@"
}

# A subshell, so that the caller stays in its folder and relative paths keep their meaning.
(
    cd "$project_root"
    # What .venv was made from, written last; the folder too, since installed commands hold it.
    stamp=.venv/nbtrack_setup
    made_from="$project_root $(cat environment/requirements.txt pyproject.toml | cksum)"
    [[ -f $stamp && $(cat "$stamp") == "$made_from" ]] && exit
    python=$(find_python)
    moved=""
    [[ -f $stamp && $(cat "$stamp") != "$project_root "* ]] && moved=--clear
    # An environment that is there already, with a torch of its own perhaps, is completed.
    step "Setting up .venv with $("$python" --version)" "$python" -m venv $moved .venv
    step "Installing the packages of environment/requirements.txt: minutes, and 2 GB of disk" \
        pip_install -r environment/requirements.txt
    # setuptools is among the requirements, so nothing is fetched to build the package.
    step "Installing nbtrack itself" pip_install --no-deps --no-build-isolation --editable .
    printf '%s' "$made_from" >"$stamp"
)
