#!/usr/bin/env bash
# Makes the virtual environments FOLDER/floor and FOLDER/newest: the dependencies of an embedder (pyproject.toml)
# at the oldest and at the newest versions allowed, and nothing else. Keeps those that are up to date; a version
# released since is fetched after `make clean`.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$1
python=${PYTHON:-python3}
version=$("$python" -c 'import sys; print("python", sys.version.split()[0])')
wanted=$("$python" -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"])')

make_venv() { # NAME REQUIREMENT...
  local venv=$folder/$1
  shift
  [ "$(cat "$venv/made_of" 2>/dev/null)" = "$version $*" ] && return
  rm -rf "$venv"
  "$python" -m venv --without-pip "$venv"
  "$python" -m pip --python "$venv/bin/python" install -qq --no-compile --disable-pip-version-check --only-binary :all: "$@"
  echo "$version $*" > "$venv/made_of"
}

# shellcheck disable=SC2086 # one argument a requirement
make_venv floor ${wanted//>=/==} &
floor=$!
# shellcheck disable=SC2086
make_venv newest $wanted
wait "$floor"
