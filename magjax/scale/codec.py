"""Results as JSON and back without losing a bit, and digests that tell whether inputs are the same.

A float is written in the shortest form that reads back to itself; an array as its dtype, shape and bytes (base64).
"""

import base64
import dataclasses
import functools
import hashlib
from pathlib import PurePath

import numpy as np

ARRAY = "__array__"


def encode(value):
    """A result as plain JSON values. Raises `TypeError` for what is neither a number, text, array, list nor dict."""
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return float(value)
    if isinstance(value, np.generic):
        return encode(value.item())
    if isinstance(value, dict):
        return {str(k): encode(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [encode(v) for v in value]
    if hasattr(value, "__array__"):
        array = np.ascontiguousarray(value)
        if array.dtype.kind in "biufc":
            shape = list(np.shape(value))  # ascontiguousarray makes a scalar a row
            return {ARRAY: array.dtype.str, "shape": shape, "bytes": base64.b64encode(array.tobytes()).decode("ascii")}
    raise TypeError(f"a chunk may return numbers, text, arrays, lists and dicts, not {type(value).__name__}")


def decode(value):
    """What `encode` was given, tuples as lists."""
    if isinstance(value, list):
        return [decode(v) for v in value]
    if not isinstance(value, dict):
        return value
    if ARRAY in value:
        return np.frombuffer(base64.b64decode(value["bytes"]), dtype=value[ARRAY]).reshape(value["shape"]).copy()
    return {k: decode(v) for k, v in value.items()}


def digest(*values) -> str:
    """SHA-256 (first 32 hex digits) of values: the same in every process and on every machine for equal content."""
    state = hashlib.sha256()
    for value in values:
        _absorb(state, value)
    return state.hexdigest()[:32]


def _absorb(state, value):
    """Each value enters with its kind and size, so that different values cannot run together."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, complex, str, PurePath)):
        _mark(
            state,
            type(value).__name__ if not isinstance(value, PurePath) else "path",
            repr(str(value) if isinstance(value, PurePath) else value),
        )
    elif isinstance(value, bytes):
        _mark(state, "bytes", len(value))
        state.update(value)
    elif isinstance(value, dict):
        _mark(state, "dict", len(value))
        for key, inner in value.items():
            _absorb(state, key)
            _absorb(state, inner)
    elif isinstance(value, (list, tuple)):
        _mark(state, "list", len(value))
        for inner in value:
            _absorb(state, inner)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [f.name for f in dataclasses.fields(value)]
        _mark(state, _name(type(value)), len(fields))
        for name in fields:
            _absorb(state, name)
            _absorb(state, getattr(value, name))
    elif isinstance(value, functools.partial):
        _absorb(state, (value.func, value.args, value.keywords))
    elif hasattr(value, "__array__"):
        array = np.ascontiguousarray(value)
        _mark(state, "array", f"{array.dtype.str}{np.shape(value)}")
        state.update(array.tobytes())
    elif hasattr(value, "tocoo"):  # sparse, as scipy has it
        entries = value.tocsc()
        _absorb(state, ("sparse", entries.shape, entries.data, entries.indices, entries.indptr))
    elif callable(value) and hasattr(value, "__qualname__"):
        _mark(state, "function", _name(value))
    else:
        raise TypeError(f"no digest of a {type(value).__name__}; give numbers, text, arrays, lists, dicts or dataclasses")


def _name(thing):
    return f"{thing.__module__}.{thing.__qualname__}"


def _mark(state, kind, size):
    state.update(f"|{kind}:{size}|".encode())
