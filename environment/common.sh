# shellcheck shell=bash
# Sourced by the other scripts: sets the project up on first use, and defines `project_root`,
# `venv_python` and `step`. Keeps to bash 3.2, which macOS ships.

project_root=$(CDPATH='' cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
venv_python="$project_root/.venv/bin/python"

# Paths below are relative to the root, where the set-up works.
requirements=environment/requirements.txt
stamp=.venv/nbtrack_setup           # what .venv was made from; written last
unfinished=.venv/nbtrack_unfinished # process number of a set-up at work, or killed

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 2
}

# step DESCRIPTION COMMAND...: runs the command between a line that announces it and its seconds.
step() {
    local description=$1 start=$SECONDS
    shift
    printf '== %s ...\n' "$description"
    "$@"
    printf '== done in %d s\n' "$((SECONDS - start))"
}

is_supported() {
    "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' >/dev/null 2>&1
}

# Prints a Python 3.11 to 3.13 that can make environments. Commands are tried, not only looked up:
# version managers leave commands in place for versions that are not switched on.
find_python() {
    local candidate without_venv=""
    for candidate in ${PYTHON:+"$PYTHON"} python3 python3.13 python3.12 python3.11 python; do
        if is_supported "$candidate"; then
            if "$candidate" -c 'import ensurepip, venv' >/dev/null 2>&1; then
                printf '%s\n' "$candidate"
                return
            fi
            without_venv=${without_venv:-$candidate}
        fi
        # A Python that was named is taken or refused, never replaced in silence.
        if [[ -n ${PYTHON:-} ]]; then
            break
        fi
    done
    if [[ -n $without_venv ]]; then
        fail "$without_venv lacks venv or ensurepip: install them (Debian, Ubuntu:" \
            "apt install python3-venv) or name another Python with PYTHON=/path/to/python3.12"
    elif [[ -n ${PYTHON:-} ]]; then
        fail "PYTHON=$PYTHON is no Python 3.11, 3.12 or 3.13 that runs: name another or unset it"
    fi
    fail "found no Python 3.11, 3.12 or 3.13: install one, or name it with" \
        "PYTHON=/path/to/python3.12"
}

# What .venv depends on. The folder comes first: installed commands hold its absolute path.
describe_setup() {
    printf '%s\n' "$project_root"
    cksum <"$requirements"
    cksum <pyproject.toml
}

# Stops if another set-up is at work; removes what is left of one that was killed, and what has
# been moved here from elsewhere. An environment that somebody else made is kept.
check_old_venv() {
    local process
    if [[ -f $unfinished ]]; then
        process=$(cat "$unfinished")
        # Numbers are used again, in containers even the own one: what runs must be a set-up.
        if [[ $process != "$$" &&
            $(ps -p "${process:-0}" -o args= 2>/dev/null) =~ (reproduce|test)\.sh ]]; then
            fail "process $process is setting up .venv: wait until it has finished, or stop it"
        fi
        step "The last set-up did not finish: removing .venv to start again" rm -rf .venv
    elif [[ -f $stamp && $(head -n 1 "$stamp") != "$project_root" ]]; then
        step ".venv comes from another folder: removing it to start again" rm -rf .venv
    elif [[ -d .venv ]] && ! is_supported "$venv_python"; then
        fail ".venv holds no Python 3.11, 3.12 or 3.13 that runs: remove .venv and start again"
    fi
}

make_venv() {
    mkdir .venv
    printf '%s\n' $$ >"$unfinished"
    "$1" -m venv .venv
}

# The usual torch for Linux carries CUDA along. Who has configured pip has chosen already.
hint_cpu_build() {
    if [[ $(uname -s) == Linux ]] && ! command -v nvidia-smi >/dev/null &&
        ! [[ $("$venv_python" -m pip config list) =~ index-url|find-links ]] &&
        ! "$venv_python" -c 'import torch' 2>/dev/null; then
        printf '   %s %s\n' "No NVIDIA GPU? The CPU build of torch saves gigabytes:" \
            "set PIP_EXTRA_INDEX_URL to its address on PyTorch's page \"Start Locally\"."
    fi
}

# Twice quiet: errors only.
pip_install() {
    "$venv_python" -m pip install --quiet --quiet --no-input --disable-pip-version-check "$@"
}

set_up() {
    local python
    if [[ -f $stamp && $(cat "$stamp") == "$(describe_setup)" ]] && is_supported "$venv_python"; then
        return
    fi
    check_old_venv
    if [[ ! -d .venv ]]; then
        python=$(find_python)
        step "Making .venv with $("$python" --version)" make_venv "$python"
    fi
    rm -f "$stamp"
    printf '%s\n' $$ >"$unfinished"
    hint_cpu_build
    step "Installing the packages of $requirements: minutes, and 2 GB of disk" \
        pip_install -r "$requirements"
    # setuptools is among the requirements, so nothing is fetched to build the package.
    step "Installing nbtrack itself" pip_install --no-deps --no-build-isolation --editable .
    describe_setup >"$stamp"
    rm "$unfinished"
}

# A subshell, so that the caller stays in its folder and relative paths keep their meaning.
(
    cd "$project_root" || exit
    set_up
)
