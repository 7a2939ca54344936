"""An ONNX file's bytes as plain values, read without the onnx package and more strictly than any other reader.

ONNX is a protobuf, and protobuf parsers differ in what they accept: tags above 32 bits, numbers with needless bytes,
singular fields that stand twice, unknown fields. Bytes that one parser skips, another one may execute. A protobuf has
one canonical form, the one that serializers write: this reader accepts that form alone, and only fields of ``SCHEMA``.
So every parser sees in an accepted file what this one sees.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple, TypeAlias

Message: TypeAlias = dict[str, Any]

MAX_FIELDS = 500_000  # a second's reading

# Message -> field -> (number, kind). "*" marks a repeated field. "opaque" is a message that is
# not read: the audit refuses whoever holds it, by name. A field that the exporter never writes is left out.
# fmt: off
SCHEMA: dict[str, dict[str, tuple[int, str]]] = {
    "ModelProto": {
        "ir_version": (1, "int64"), "producer_name": (2, "string"), "producer_version": (3, "string"),
        "graph": (7, "GraphProto"), "opset_import": (8, "OperatorSetIdProto*"),
        "metadata_props": (14, "StringStringEntryProto*"),
    },
    "OperatorSetIdProto": {"domain": (1, "string"), "version": (2, "int64")},
    "StringStringEntryProto": {"key": (1, "string"), "value": (2, "string")},
    "GraphProto": {
        "node": (1, "NodeProto*"), "name": (2, "string"), "initializer": (5, "TensorProto*"),
        "input": (11, "ValueInfoProto*"), "output": (12, "ValueInfoProto*"),
    },
    "NodeProto": {
        "input": (1, "string*"), "output": (2, "string*"), "name": (3, "string"), "op_type": (4, "string"),
        "attribute": (5, "AttributeProto*"), "domain": (7, "string"),
    },
    "AttributeProto": {
        "name": (1, "string"), "f": (2, "float"), "i": (3, "int64"), "s": (4, "bytes"), "g": (6, "opaque"),
        "floats": (7, "float*"), "ints": (8, "int64*"), "strings": (9, "bytes*"), "graphs": (11, "opaque*"),
        "type": (20, "enum"),
    },
    "TensorProto": {
        "dims": (1, "int64*"), "data_type": (2, "int32"), "name": (8, "string"), "raw_data": (9, "bytes"),
        "external_data": (13, "opaque*"), "data_location": (14, "enum"),
    },
    "ValueInfoProto": {
        "name": (1, "string"), "type": (2, "TypeProto"), "metadata_props": (4, "StringStringEntryProto*"),
    },
    "TypeProto": {"tensor_type": (1, "Tensor")},
    "Tensor": {"elem_type": (1, "int32"), "shape": (2, "TensorShapeProto")},
    "TensorShapeProto": {"dim": (1, "Dimension*")},
    "Dimension": {"dim_value": (1, "int64")},
}
# fmt: on
_REFUSED = {
    ("ModelProto", 20): "training data",
    ("ModelProto", 25): "functions",
    ("GraphProto", 15): "sparse tensors",
}
_WIRE = {"int64": 0, "int32": 0, "enum": 0, "float": 5}  # everything else has a length: 2
_ENUM_END = 15  # of AttributeProto.type: parsers put a value that they do not know among the unknown fields


class _Field(NamedTuple):
    name: str
    number: int
    kind: str
    repeated: bool


# Message -> tag (number and wire type in one) -> field: a tag that is not here is refused.
_FIELDS = {
    message: {
        number << 3 | _WIRE.get(kind.rstrip("*"), 2): _Field(name, number, kind.rstrip("*"), kind.endswith("*"))
        for name, (number, kind) in fields.items()
    }
    for message, fields in SCHEMA.items()
}


def read_model(data: bytes) -> Message:
    """The ModelProto in ``data``: field name -> value, for the fields that stand in the bytes.

    Messages are dicts, repeated fields lists; a field that the bytes do not hold has no entry.

    Raises ValueError where the bytes are not the canonical form of a message of ``SCHEMA``: fields
    in ascending order of their numbers, singular ones once, numbers and tags in as few bytes as
    possible and within the range of their type, lists of numbers unpacked, strings UTF-8, nothing else.
    """
    return _Reader(data).message("ModelProto", 0, len(data))


class _Reader:
    """The bytes, and how many fields may still be read."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.left = MAX_FIELDS

    def message(self, kind: str, at: int, end: int) -> Message:
        """The message of the bytes ``at`` to ``end``."""
        fields, result, last = _FIELDS[kind], Message(), 0
        while at < end:
            tag, at = self.varint(at, end)
            field = fields.get(tag)
            if field is None:
                what = _REFUSED.get((kind, tag >> 3), f"field {tag >> 3} (wire type {tag & 7})")
                raise ValueError(f"{kind} holds {what}, which no controller's file has")
            if field.number < last or (field.number == last and not field.repeated):
                raise ValueError(f"{kind} has its field {field.name!r} twice or out of order")
            self.left -= 1
            if self.left < 0:
                raise ValueError(f"it has more than {MAX_FIELDS} fields")
            last = field.number
            value, at = self.value(field, at, end)
            if field.repeated:
                result.setdefault(field.name, []).append(value)
            else:
                result[field.name] = value
        return result

    def value(self, field: _Field, at: int, end: int) -> tuple[Any, int]:
        """One field's value, and where the next field starts."""
        if field.kind == "float":
            if at + 4 > end:
                raise ValueError(f"field {field.name!r} runs past its message")
            return struct.unpack_from("<f", self.data, at)[0], at + 4
        number, at = self.varint(at, end)
        if field.kind in _WIRE:
            return _integer(field, number), at
        stop = at + number
        if stop > end:
            raise ValueError(f"field {field.name!r} runs past its message")
        if field.kind in _FIELDS:
            return self.message(field.kind, at, stop), stop
        content = self.data[at:stop]
        return content.decode() if field.kind == "string" else content, stop

    def varint(self, at: int, end: int) -> tuple[int, int]:
        """An unsigned number of 7 bits a byte, and where the next one starts."""
        value = shift = 0
        while True:
            if at >= end:
                raise ValueError("a number runs past its message")
            byte = self.data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
            shift += 7
            if shift > 63:
                raise ValueError("a number has more than 64 bits")
        if byte == 0 and shift:
            raise ValueError("a number has more bytes than it needs")
        if value >> 64:
            raise ValueError("a number has more than 64 bits")
        return value, at


def _integer(field: _Field, number: int) -> int:
    """The number that the field's type makes of 64 bits; ValueError where parsers could differ."""
    if field.kind == "int64":
        return number - 2**64 if number >> 63 else number
    if number >= (_ENUM_END if field.kind == "enum" else 2**31):
        raise ValueError(f"field {field.name!r} is {number}, which is out of its range")
    return number


def write_model(model: Message) -> bytes:
    """The canonical bytes of a ModelProto as ``read_model`` gives it: read again they are the same message."""
    return _written("ModelProto", model)


def _written(kind: str, message: Message) -> bytes:
    parts = []
    for name, (number, of) in sorted(SCHEMA[kind].items(), key=lambda item: item[1][0]):
        if name in message:
            of, tag = of.rstrip("*"), _varint(number << 3 | _WIRE.get(of.rstrip("*"), 2))
            rows = message[name] if isinstance(message[name], list) else [message[name]]
            parts += [tag + _value(of, row) for row in rows]
    return b"".join(parts)


def _value(kind: str, value: Any) -> bytes:
    if kind == "float":
        return struct.pack("<f", value)
    if kind in _WIRE:
        return _varint(value % 2**64)
    content = _written(kind, value) if kind in _FIELDS else value.encode() if kind == "string" else value
    return _varint(len(content)) + content


def _varint(value: int) -> bytes:
    """An unsigned number of 7 bits a byte."""
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])
