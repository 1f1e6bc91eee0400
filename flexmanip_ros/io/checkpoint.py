"""The state of an estimator in a file: exact to the bit, safe to read, written whole or not at all.

A state is a tree of NamedTuples, frozen dataclasses, enumerations, plain values and arrays. The file holds
the tree as JSON and the arrays as bytes, under a checksum: a damaged file is refused, never half believed.
Reading makes only classes of this package that are of those kinds, so no file can run anything.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib
import json
import math
import os
import struct
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

import flexmanip_ros
from flexmanip_ros.errors import CheckpointError

MAGIC = b'flexmanip_ros checkpoint 1\n'
LENGTH = struct.Struct('<Q')
SEAL = 32
"""Bytes of the checksum."""
PACKAGE = 'flexmanip_ros.'
_AGAIN = 'it starts anew'


def save(path: str | Path, value: Any) -> None:
    """Write a value; the old file stays until the new one is complete. Raises CheckpointError."""
    target = Path(path)
    partial = target.with_name(target.name + '.partial')
    try:
        partial.write_bytes(encode(value))
        os.replace(partial, target)
    except OSError as err:
        with contextlib.suppress(OSError):
            partial.unlink()  # half a state helps nobody, least on a full disk
        raise CheckpointError(f"checkpoint '{path}' cannot be written: {err.strerror}",
                              'give another checkpoint_file, or free some space') from err


def load(path: str | Path) -> Any:
    """Return what was saved; None when there is no file. Raises CheckpointError for any other file."""
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        return None
    except OSError as err:
        raise CheckpointError(f"checkpoint '{path}' cannot be read: {err.strerror}", _AGAIN) from err
    return decode(data)


def encode(value: Any) -> bytes:
    """Return a value as bytes."""
    blob = bytearray()
    tree = _plain(value, blob, {})
    text = json.dumps({'version': flexmanip_ros.__version__, 'tree': tree}, allow_nan=False).encode()
    return sealed(text, bytes(blob))


def sealed(text: bytes, blob: bytes) -> bytes:
    """Return tree and arrays with their checksum."""
    body = LENGTH.pack(len(text)) + text + blob
    return MAGIC + hashlib.sha256(body).digest() + body


def decode(data: bytes) -> Any:
    """Return the value in the bytes. Raises CheckpointError for anything else."""
    if not data.startswith(MAGIC):
        raise CheckpointError('the file is no checkpoint', _AGAIN)
    seal, body = data[len(MAGIC):len(MAGIC) + SEAL], data[len(MAGIC) + SEAL:]
    if hashlib.sha256(body).digest() != seal:
        raise CheckpointError('the checkpoint is damaged', _AGAIN)
    try:
        size = LENGTH.unpack_from(body)[0]
        document = json.loads(body[LENGTH.size:LENGTH.size + size])
        version = document['version']
        if version == flexmanip_ros.__version__:
            return _value(document['tree'], body[LENGTH.size + size:], {})
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, ImportError, struct.error,
            RecursionError, MemoryError, OverflowError) as err:
        raise CheckpointError('the checkpoint was not written by this package', _AGAIN) from err
    raise CheckpointError(f'the checkpoint is of version {version}', _AGAIN)


def _plain(value: Any, blob: bytearray, known: dict[int, tuple[dict[str, Any], Any]]) -> Any:
    """Return a value as JSON has it; arrays go to the blob, each only once."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, Enum):
        return {'enum': _name(type(value)), 'member': value.name}
    if isinstance(value, np.ndarray):
        if id(value) not in known:
            known[id(value)] = (_array(value, blob), value)
        return known[id(value)][0]
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else {'float': repr(float(value))}
    if isinstance(value, tuple):
        items = [_plain(item, blob, known) for item in value]
        named = hasattr(value, '_fields')
        return {'named': _name(type(value)), 'items': items} if named else {'tuple': items}
    if dataclasses.is_dataclass(value):
        parts = {item.name: _plain(getattr(value, item.name), blob, known)
                 for item in dataclasses.fields(value)}
        return {'data': _name(type(value)), 'parts': parts}
    raise TypeError(f'no place in a checkpoint for {type(value).__name__}')


def _array(value: np.ndarray[Any, Any], blob: bytearray) -> dict[str, Any]:
    if value.dtype.kind not in 'biuf':
        raise TypeError(f'no place in a checkpoint for an array of {value.dtype}')
    fortran = bool(value.flags.f_contiguous and not value.flags.c_contiguous)
    blob += b'\0' * (-len(blob) % 8)
    at = len(blob)
    blob += value.tobytes(order='F' if fortran else 'C')
    return {'array': value.dtype.str, 'shape': list(value.shape), 'fortran': fortran, 'at': at}


def _value(tree: Any, blob: bytes, arrays: dict[int, np.ndarray[Any, Any]]) -> Any:
    if not isinstance(tree, dict):
        if tree is None or isinstance(tree, (bool, int, float, str)):
            return tree
        raise ValueError('a bare list')
    if 'array' in tree:
        return _read_array(tree, blob, arrays)
    if 'tuple' in tree:
        return tuple(_value(item, blob, arrays) for item in tree['tuple'])
    if 'float' in tree:
        return float(tree['float'])
    if 'enum' in tree:
        return _class(tree['enum'], Enum)[tree['member']]
    if 'named' in tree:
        return _class(tree['named'], tuple)._make(_value(item, blob, arrays) for item in tree['items'])
    parts = {name: _value(part, blob, arrays) for name, part in tree['parts'].items()}
    return _class(tree['data'], None)(**parts)


def _read_array(tree: dict[str, Any], blob: bytes, arrays: dict[int, np.ndarray[Any, Any]]) -> Any:
    at, dtype, shape = int(tree['at']), np.dtype(tree['array']), tuple(int(n) for n in tree['shape'])
    if dtype.kind not in 'biuf' or at < 0 or min(shape, default=0) < 0:
        raise ValueError('not an array of numbers')
    count = math.prod(shape)
    if at + count * dtype.itemsize > len(blob):
        raise ValueError('an array runs past the end')
    if at not in arrays or arrays[at].shape != shape or arrays[at].dtype != dtype:
        flat = np.frombuffer(blob, dtype, count, at) if count else np.empty(0, dtype)
        arrays[at] = np.array(flat).reshape(shape, order='F' if tree['fortran'] else 'C')
    return arrays[at]


def _name(cls: type) -> str:
    return f'{cls.__module__}:{cls.__qualname__}'


def _class(name: str, base: type | None) -> Any:
    """Return a class of this package by name; nothing else can be named."""
    module, _, qualified = name.partition(':')
    if not module.startswith(PACKAGE) or '.' in qualified:
        raise ValueError(f"'{name}' is not of this package")
    found = getattr(importlib.import_module(module), qualified)
    fits = dataclasses.is_dataclass(found) if base is None else issubclass(found, base)
    if not isinstance(found, type) or not fits or found.__module__ != module:
        raise ValueError(f"'{name}' is no value")
    return found
