#!/usr/bin/env bash
# tests.sh ARGUMENT...: mypy and pytest side by side. mypy computes on one core for 40 s, behind tests that keep time.
# Fails if either does; what mypy finds is printed when it ends.
set -uo pipefail
cd "$(dirname "$0")/.."
said=$(mktemp)
(
  nice mypy > "$said" 2>&1 &
  trap "kill $! 2> /dev/null" TERM
  wait $! || { status=$?; cat "$said" >&2; exit "$status"; }
) &
types=$!
trap 'kill "$types" 2> /dev/null; rm -f "$said"' EXIT
python -m pytest "$@"
status=$?
[ "$status" = 2 ] && exit 2 # Ctrl-C
wait "$types" || { echo "tests.sh: mypy failed, see above" >&2; status=1; }
exit "$status"
