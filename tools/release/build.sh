#!/usr/bin/env bash
# Builds the source archive of the files that git does not ignore, and the wheel of the archive, into FOLDER: so the archive
# is complete, and nothing of an earlier build gets into either. Prints the wheel's path.
# PYTHON is one that has the group `release` of pyproject.toml (tools/release/venvs.sh).
set -euo pipefail
cd "$(dirname "$0")/../.."
folder=$1
copy=$(mktemp -d)
trap 'rm -rf "$copy"' EXIT

git ls-files -z --cached --others --exclude-standard | while IFS= read -r -d '' file; do [ ! -e "$file" ] || printf '%s\0' "$file"; done |
  tar --null --files-from=- --create --file=- | tar --extract --file=- --directory="$copy"
mkdir -p "$folder"
rm -f "$folder"/loopwright-*.whl "$folder"/loopwright-*.tar.gz
# The same commit gives the same wheel.
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
export SOURCE_DATE_EPOCH
"$PYTHON" -W ignore -m build --no-isolation --outdir "$folder" "$copy" > "$copy/said" 2>&1 || { cat "$copy/said" >&2; exit 1; }
ls "$folder"/loopwright-*.whl
