#!/usr/bin/env bash
# Makes the virtual environments FOLDER/tools, which builds and examines a release, and FOLDER/bare, which has the
# packages of an embedder and nothing else. Keeps those that are up to date.
set -euo pipefail
cd "$(dirname "$0")/../.."
folder=$1
python=${PYTHON:-python3}
version=$("$python" -c 'import sys; print("python", sys.version.split()[0])')
listed() { "$python" -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))$1, sep='\n')"; }
pip_into() { "$python" -m pip --python "$1/bin/python" install -qq --no-compile --disable-pip-version-check --only-binary :all: "${@:2}"; }

make_venv() { # NAME REQUIREMENT...
  local venv=$folder/$1 made_of
  shift
  made_of="$version $* $(cksum < constraints.txt)"
  [ "$(cat "$venv/made_of" 2>/dev/null)" = "$made_of" ] && return
  rm -rf "$venv"
  "$python" -m venv --without-pip "$venv"
  pip_into "$venv" -c constraints.txt "$@"
  # For its copy of the schema of CITATION.cff; its code, which asks for old packages, does not run.
  case $venv in */tools) pip_into "$venv" --no-deps cffconvert==2.0.0 ;; esac
  echo "$made_of" > "$venv/made_of"
}

mapfile -t wanted < <(listed '["dependency-groups"]["release"]')
make_venv tools "${wanted[@]}"
mapfile -t wanted < <(listed '["project"]["dependencies"]')
make_venv bare "${wanted[@]}"
