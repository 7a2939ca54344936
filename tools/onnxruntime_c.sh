#!/usr/bin/env bash
# onnxruntime_c.sh FOLDER: makes FOLDER/include and FOLDER/lib for examples/embed/c/onnxruntime, without a network: the header that
# the package ships, and the library of the Python package onnxruntime, which is installed already. Any release of the
# library serves a header that is no newer. A person may unpack a release archive of onnxruntime instead.
set -euo pipefail
folder=${1:?"name the folder to make: onnxruntime_c.sh FOLDER"}
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
python=${PYTHON:-python3}

library=$("$python" -c '
import importlib.util, pathlib
found = importlib.util.find_spec("onnxruntime")
print(*sorted(pathlib.Path(found.origin).parent.glob("capi/libonnxruntime.so.*")) if found and found.origin else [])
')
test -n "$library" || {
  echo "onnxruntime_c.sh: $python has no package onnxruntime with a libonnxruntime.so; \`$python -m pip install onnxruntime\`" \
    "brings it, and PYTHON=... names another Python" >&2
  exit 1
}
test -f "$library" || { echo "onnxruntime_c.sh: the package onnxruntime has several libraries: $library" >&2; exit 1; }
mkdir -p "$folder/lib" "$folder/include"
ln -sf "$library" "$folder/lib/libonnxruntime.so.1"
ln -sf libonnxruntime.so.1 "$folder/lib/libonnxruntime.so"
cp "$root/pipeline/hosts/c/onnxruntime/onnxruntime_c_api.h" "$folder/include/"
