"""Messages without ROS: their definitions, and reading and writing them as CDR.

For what is not hot; :mod:`srtomo_core.wire` has the messages of every frame.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from srtomo_core.wire import PACKAGE


class MessageError(ValueError):
    """A type that does not exist, or bytes or values that are no message of it."""


def _message_folder() -> Path:
    """The installed definitions; from a source tree that is not installed, its own."""
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    folders = [Path(prefix) / "share" / PACKAGE / "msg" for prefix in prefixes]
    folders.append(Path(__file__).resolve().parents[1] / PACKAGE / "msg")
    for folder in folders:
        if folder.is_dir():
            return folder
    raise MessageError(f"{PACKAGE}: no message definitions under {', '.join(prefixes)}: is srtomo installed?")


@cache
def message_types() -> Mapping[str, str]:
    """Every message of ``msgs_schema``: type name, e.g. ``msgs_schema/msg/SlopeFrame``, to its ``.msg`` text.

    Raises:
        MessageError: the definitions are not installed.
    """
    return {f"{PACKAGE}/msg/{p.stem}": p.read_text(encoding="utf-8") for p in sorted(_message_folder().glob("*.msg"))}


@cache
def typestore() -> Typestore:
    """The messages of ROS 2 Jazzy and ours."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in message_types().items():
        store.register(get_types_from_msg(text, name))
    return store


def definition(type_name: str) -> str:
    """The full ``ros2msg`` definition of a type: its text, then those of the types that it is made of.

    Our own text is kept as it stands, so that units and meanings travel with the bag.

    Raises:
        MessageError: no such type.
    """
    _check_type(type_name)
    generated, _ = typestore().generate_msgdef(type_name, ros_version=2)
    text, separator, parts = generated.partition("=" * 80 + "\n")
    return message_types().get(type_name, text).rstrip() + "\n" + separator + parts


def type_hash(type_name: str) -> str:
    """The hash (RIHS01) by which ROS 2 tells two definitions of a type apart.

    Raises:
        MessageError: no such type.
    """
    _check_type(type_name)
    return typestore().hash_rihs01(type_name)


def _check_type(type_name: str) -> None:
    if type_name not in typestore().fielddefs:
        raise MessageError(f"{type_name}: no such message type in ROS 2 Jazzy or {PACKAGE}")


def decode(type_name: str, data: bytes) -> Any:
    """A serialised message as an object with the message's fields; numeric sequences are numpy arrays.

    Raises:
        MessageError: no such type, or not a message of it.
    """
    _check_type(type_name)
    try:
        return typestore().deserialize_cdr(data, type_name)
    # the generated readers raise whatever the bytes lead them to
    except Exception as error:
        raise MessageError(f"{len(data)} bytes are no {type_name}: {error}") from None


@cache
def _recorded_typestore(type_name: str, text: str) -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, type_name))
    return store


def decode_recorded(type_name: str, data: bytes, text: str) -> Any:
    """A serialised message of the definition that was recorded with it, as :func:`decode` gives one of ours.

    Fields that were not there yet are zero or empty: what is new in a message has to mean, by that, what was before.

    Raises:
        MessageError: no such type, or not a message of it.
    """
    _check_type(type_name)
    if text == definition(type_name):
        return decode(type_name, data)
    try:
        old = _recorded_typestore(type_name, text).deserialize_cdr(data, type_name)
    except Exception as error:
        raise MessageError(f"{len(data)} bytes are no {type_name} as recorded: {error}") from None
    fields = {name: getattr(old, name, empty) for name, empty in vars(_message(type_name, {})).items()}
    return typestore().types[type_name](**fields)


def encode(type_name: str, **fields: Any) -> bytes:
    """Serialise a message; fields that are not given are zero or empty, nested messages are mappings.

    Raises:
        MessageError: no such type or field, or a value that does not fit.
    """
    _check_type(type_name)
    try:
        return bytes(typestore().serialize_cdr(_message(type_name, fields), type_name))
    except MessageError:
        raise
    except Exception as error:
        raise MessageError(f"{type_name}: {error}") from None


def _message(type_name: str, values: Mapping[str, Any]) -> Any:
    fields = dict(typestore().fielddefs[type_name][1])
    if unknown := [name for name in values if name not in fields]:
        raise MessageError(f"{type_name}: no field {unknown[0]} (expected one of {', '.join(fields)})")
    return typestore().types[type_name](**{name: _value(kind, values.get(name)) for name, kind in fields.items()})


def _value(kind: Any, value: Any) -> Any:
    node, detail = kind
    if node == Nodetype.NAME:
        return _message(detail, value or {})
    if node == Nodetype.BASE:
        base = detail[0]
        empty: Any = "" if base in ("string", "wstring") else False if base == "bool" else 0
        return empty if value is None else value
    (inner, inner_detail), length = detail
    if inner == Nodetype.BASE and inner_detail[0] not in ("string", "wstring"):
        dtype = {"octet": "uint8", "char": "uint8"}.get(inner_detail[0], inner_detail[0])
        if isinstance(value, bytes | bytearray):
            value = np.frombuffer(value, np.uint8)
        return np.zeros(length if node == Nodetype.ARRAY else 0, dtype) if value is None else np.asarray(value, dtype)
    count = length if node == Nodetype.ARRAY else 0
    return [_value((inner, inner_detail), item) for item in (value if value is not None else [None] * count)]
