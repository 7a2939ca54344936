#!/usr/bin/env bash
# Makes the virtual environment. Stops before it would fetch gigabytes of CUDA packages by accident.
set -euo pipefail
venv=$1
python=${PYTHON:-python3}
say() { printf 'setup: %s\n' "$*" >&2; }

"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
  { say "$("$python" --version 2>&1) is too old; Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11 ..."; exit 1; }
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"

torch=$(sed -n 's/^ *"\(torch==[^"]*\)".*/\1/p' pyproject.toml)
if [ "${ALLOW_CUDA:-0}" != 1 ]; then
  report=$(mktemp)
  trap 'rm -f "$report"' EXIT
  "$venv/bin/python" -m pip install --quiet --dry-run --report "$report" "$torch" -c constraints.txt
  cuda=$("$venv/bin/python" - "$report" <<'PY'
import json, sys
names = [row["metadata"]["name"].lower() for row in json.load(open(sys.argv[1]))["install"]]
print(sum(name.startswith(("nvidia-", "cuda-")) for name in names))
PY
)
  if [ "$cuda" != 0 ]; then
    say "$torch would bring $cuda CUDA packages (nvidia-*, several GB), which nothing here needs: point pip at PyTorch's CPU wheels (PIP_EXTRA_INDEX_URL or PIP_FIND_LINKS; pytorch.org, 'Get started', names them), or set ALLOW_CUDA=1"
    exit 1
  fi
fi

say "installing into $venv (a few minutes the first time)"
# Python compiles on first use what is used, a third of the files: pip would compile all of them, one by one.
"$venv/bin/python" -m pip install --quiet --no-compile -c constraints.txt "$torch" -e '.[pipeline,dev]'
say "ready; \`source $venv/bin/activate\` brings the command loopwright"
