#!/usr/bin/env bash
# tests.sh ARGUMENT...: import rules and mypy beside pytest; they compute for 45 s, behind tests that keep time.
# Fails if any does; what they find is printed when they end.
set -uo pipefail
cd "$(dirname "$0")/.."
said=$(mktemp)
check() { # a program, whose findings are kept until it ends
  nice "$@" > "$said" 2>&1 &
  child=$!
  wait "$child" || { status=$?; cat "$said" >&2; exit "$status"; }
}
(
  trap 'kill "$child" 2> /dev/null' TERM
  check lint-imports
  check mypy
) &
types=$!
trap 'kill "$types" 2> /dev/null; rm -f "$said"' EXIT
python -m pytest "$@"
status=$?
[ "$status" = 2 ] && exit 2 # Ctrl-C
wait "$types" || { echo "tests.sh: import rules or types failed, see above" >&2; status=1; }
exit "$status"
