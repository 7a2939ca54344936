#!/usr/bin/env bash
# Makes FOLDER/include and FOLDER/lib for examples/embed/c from packages: the header of Debian's libonnxruntime-dev, the
# library of the Python package onnxruntime, which is installed already. Any release of the library serves a header that
# is no newer. A person may unpack a release archive of onnxruntime instead.
set -euo pipefail
cd "$(dirname "$0")/.."
mkdir -p "$1"
folder=$(cd "$1" && pwd)
python=${PYTHON:-python3}
suite=trixie # the first with libonnxruntime-dev; 1.21.0 does not change there any more

library=$("$python" -c 'import onnxruntime, pathlib; print(*sorted(pathlib.Path(onnxruntime.__file__).parent.glob("capi/libonnxruntime.so.*")))')
test -f "$library" || { echo "the Python package onnxruntime has no libonnxruntime.so: $library" >&2; exit 1; }
mkdir -p "$folder/lib" "$folder/include"
ln -sf "$library" "$folder/lib/libonnxruntime.so.1"
ln -sf libonnxruntime.so.1 "$folder/lib/libonnxruntime.so"
[ -s "$folder/include/onnxruntime_c_api.h" ] && exit

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
if ! apt-get -qq download libonnxruntime-dev 2> /dev/null; then
  # An older Debian: its own archive, another suite, and nothing of the machine's apt is changed.
  archive=$(grep -rhoE '^[^#]*https?://[^ ]+/debian/?( |$)' /etc/apt/sources.list /etc/apt/sources.list.d 2> /dev/null |
    grep -oE 'https?://[^ ]+' | sort -u | sed -n 1p || true)
  test -n "$archive" || { echo "apt knows no archive of Debian; unpack a release of onnxruntime instead" >&2; exit 1; }
  mkdir -p lists/partial cache/archives/partial parts
  keys=/usr/share/keyrings/debian-archive-keyring.gpg
  echo "deb $([ -f $keys ] && echo "[signed-by=$keys]") $archive $suite main" > sources.list
  own=(-o Dir::Etc::sourcelist="$work/sources.list" -o Dir::Etc::sourceparts="$work/parts"
    -o Dir::State::lists="$work/lists" -o Dir::Cache="$work/cache" -o APT::Sandbox::User="")
  apt-get "${own[@]}" -qq update
  apt-get "${own[@]}" -qq download libonnxruntime-dev
fi
dpkg-deb -x libonnxruntime-dev_*.deb unpacked
cp unpacked/usr/include/onnxruntime/onnxruntime_c_api.h "$folder/include/"
