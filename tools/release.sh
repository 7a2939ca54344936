#!/usr/bin/env bash
# Builds the release into dist/ and checks it: `make release` calls it, after `make setup`.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
folder=build/release
tools=$folder/tools/bin/python
controller=artifacts/thiosulfate_cstr/pid.onnx
say() { printf 'release: %s\n' "$*"; }
# What these import of loopwright must be what they have installed.
unset PYTHONPATH

say "about a minute, the first time two"
[ -z "$(git status --porcelain)" ] || say "the sources have changes that are not committed: this is no release yet"
PYTHON=$python bash tools/release/venvs.sh "$folder"
"$tools" tools/release/citation.py

rm -rf dist
wheel=$(PYTHON=$tools bash tools/release/build.sh dist)
"$tools" -m twine --no-color check --strict dist/*
name=${wheel%-py3-none-any.whl}
"$python" tools/release/content.py "$wheel" > "$name-content.txt"
say "$wheel: $(stat -c %s "$wheel" 2>/dev/null || stat -f %z "$wheel") bytes"
head -3 "$name-content.txt"

install() { # VENV REQUIREMENT: into an empty environment, as a user would
  rm -rf "$1"
  "$python" -m venv --without-pip "$1"
  "$python" -m pip --python "$1/bin/python" install -qq --no-compile --disable-pip-version-check --only-binary :all: "$2"
}
say "an empty environment with the wheel alone"
install "$folder/runtime" "$wheel"
"$folder/runtime/bin/python" tools/release/smoke.py "$controller"
say "an empty environment with the extra plant"
install "$folder/plant" "$wheel[plant]"
"$python" tools/release/smoke_plant.py "$folder/plant" "$controller" thiosulfate_cstr

say "bill of materials and licences"
"$python" tools/release/closure.py > "$folder/closure.json"
"$folder/tools/bin/cyclonedx-py" environment --no-validate --output-reproducible --short-PURLs \
  -o "$folder/environment.json" "$(command -v "$python")" 2> /dev/null
"$tools" tools/release/bill.py "$folder/closure.json" "$folder/environment.json" dist
ls -l dist | awk 'NF > 2 { print $5, $NF }'
