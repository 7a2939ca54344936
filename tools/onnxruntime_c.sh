#!/usr/bin/env bash
# Makes FOLDER/include and FOLDER/lib for examples/embed/c, without a network: the header that the package ships, and the
# library of the Python package onnxruntime, which is installed already. Any release of the library serves a header that
# is no newer. A person may unpack a release archive of onnxruntime instead.
set -euo pipefail
cd "$(dirname "$0")/.."
mkdir -p "$1/lib" "$1/include"
python=${PYTHON:-python3}

library=$("$python" -c 'import onnxruntime, pathlib; print(*sorted(pathlib.Path(onnxruntime.__file__).parent.glob("capi/libonnxruntime.so.*")))')
test -f "$library" || { echo "the Python package onnxruntime has no libonnxruntime.so: $library" >&2; exit 1; }
ln -sf "$library" "$1/lib/libonnxruntime.so.1"
ln -sf libonnxruntime.so.1 "$1/lib/libonnxruntime.so"
cp pipeline/hosts/c/onnxruntime/onnxruntime_c_api.h "$1/include/"
