"""Save the identifier's state in a file that is exact to the bit, safe to read, and written whole or not at all.

The file is a header, a SHA-256 checksum and an ``np.savez`` archive. The archive holds every array of the state (the
rows of the sample log among them) and one text, ``tree``: JSON that says which array and which plain value stands
where. Reading makes only values of this package (NamedTuples, dataclasses, enumerations), so no file can run code.
"""

import dataclasses
import hashlib
import importlib
import io
import json
import threading
import time
import zipfile
from contextlib import suppress
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import flexmanip_ros
from flexmanip_ros import pipeline
from flexmanip_ros.errors import CheckpointError, FlexmanipError
from flexmanip_ros.io.outputs import write_file
from flexmanip_ros.parameters import IdentifierParameters, flatten, leaves

NAME = b'flexmanip_ros checkpoint '
CHECKSUM = hashlib.sha256().digest_size
PACKAGE = 'flexmanip_ros.'
_NUMBERS = 'biuf'
"""numpy kinds of the arrays that a state contains: truth values, integers and floats."""
_EMPTY_START = 'the identifier starts with nothing known'


def save(path: str | Path, value: Any) -> None:
    """Write a value; the old file stays until the new one is complete. Raises CheckpointError."""
    data = encode(value)
    try:
        write_file(path, lambda file: file.write(data))
    except FlexmanipError as err:
        raise CheckpointError(f'checkpoint {err.problem}', 'give another checkpoint_file, or free some space') from err


def load(path: str | Path) -> Any:
    """Return what was saved; None when there is no file. Raises CheckpointError for any other file."""
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        return None
    except OSError as err:
        raise CheckpointError(f"checkpoint '{path}' cannot be read: {err.strerror}", _EMPTY_START) from err
    return decode(data)


def encode(value: Any) -> bytes:
    """Return a value as the bytes of a checkpoint."""
    found: dict[int, tuple[int, Any]] = {}
    tree = _plain(value, found)
    arrays = {f'array_{k}': one for k, one in found.values() if isinstance(one, np.ndarray)}
    return sealed(json.dumps({'tree': tree}), arrays)


@cache
def header() -> bytes:
    """Return the first bytes of a file: its name and a checksum of the package's sources.

    Any change of the sources may change the fields of a state or the shapes of its arrays. A kernel that takes an array
    of another shape writes beyond its end.
    """
    sources = sorted(Path(flexmanip_ros.__file__).parent.rglob('*.py'))
    whole = hashlib.sha256(b''.join(path.read_bytes() for path in sources))
    return NAME + whole.hexdigest().encode() + b'\n'


def sealed(text: str, arrays: dict[str, np.ndarray[Any, Any]]) -> bytes:
    """Return header, checksum and archive of a tree and its arrays."""
    archive = io.BytesIO()
    np.savez(archive, tree=np.frombuffer(text.encode(), np.uint8), **arrays)  # type: ignore[arg-type]
    body = archive.getvalue()
    return header() + hashlib.sha256(body).digest() + body


def decode(data: bytes) -> Any:
    """Return the value in the bytes. Raises CheckpointError for anything else."""
    if not data.startswith(NAME):
        raise CheckpointError('the file is no checkpoint', _EMPTY_START)
    if not data.startswith(header()):
        raise CheckpointError('the checkpoint has another format: other sources of this package wrote it', _EMPTY_START)
    rest = data[len(header()):]
    checksum, body = rest[:CHECKSUM], rest[CHECKSUM:]
    if hashlib.sha256(body).digest() != checksum:
        raise CheckpointError('the checkpoint is damaged: its checksum does not fit', _EMPTY_START)
    try:
        with np.load(io.BytesIO(body), allow_pickle=False) as archive:
            return _value(json.loads(archive['tree'].tobytes())['tree'], archive, [])
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, ImportError, RecursionError, MemoryError,
            OverflowError, zipfile.BadZipFile) as err:
        raise CheckpointError('the checkpoint was not written by this package', _EMPTY_START) from err


def _plain(value: Any, found: dict[int, tuple[int, Any]]) -> Any:
    """Return a value as JSON data; found: by ``id``, the arrays and dataclasses so far, each written once."""
    if isinstance(value, Enum):
        return {'enum': _name(type(value)), 'member': value.name}
    if value is None or isinstance(value, (bool, str, int, float)):
        return float(value) if isinstance(value, np.floating) else value
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, tuple):
        items = [_plain(item, found) for item in value]
        return {'named': _name(type(value)), 'items': items} if hasattr(value, '_fields') else {'tuple': items}
    if id(value) in found:
        return {'same': found[id(value)][0]}
    if isinstance(value, np.ndarray) and value.dtype.kind in _NUMBERS:
        parts = None
    elif dataclasses.is_dataclass(value):
        parts = {item.name: _plain(getattr(value, item.name), found) for item in dataclasses.fields(value)}
    else:
        raise TypeError(f'no place in a checkpoint for {type(value).__name__}')
    number = len(found)
    found[id(value)] = number, value
    return {'array': number} if parts is None else {'data': _name(type(value)), 'parts': parts}


def _value(tree: Any, archive: Any, made: list[Any]) -> Any:
    """Return the value of a part of the tree; made: the arrays and dataclasses so far, in the order of writing."""
    if not isinstance(tree, dict):
        if isinstance(tree, list):
            raise ValueError('a list without a type')
        return tree
    if 'same' in tree:
        return made[tree['same']]
    if 'tuple' in tree:
        return tuple(_value(item, archive, made) for item in tree['tuple'])
    if 'enum' in tree:
        return _class(tree['enum'], Enum)[tree['member']]
    if 'named' in tree:
        return _class(tree['named'], tuple)._make(_value(item, archive, made) for item in tree['items'])
    if 'array' in tree:
        made.append(archive[f'array_{tree["array"]}'])
    else:
        parts = {name: _value(part, archive, made) for name, part in tree['parts'].items()}
        made.append(_class(tree['data'], None)(**parts))
    return made[-1]


def _name(cls: type) -> str:
    return f'{cls.__module__}:{cls.__qualname__}'


def _class(name: str, base: type | None) -> Any:
    """Return a class of this package by name: a subclass of ``base``, or a dataclass where that is None."""
    module, _, qualified = name.partition(':')
    if not module.startswith(PACKAGE) or '.' in qualified:
        raise ValueError(f"'{name}' is not of this package")
    found = getattr(importlib.import_module(module), qualified)
    fits = dataclasses.is_dataclass(found) if base is None else issubclass(found, base)
    if not isinstance(found, type) or not fits or found.__module__ != module:
        raise ValueError(f"'{name}' is no value")
    return found


class Saved(NamedTuple):
    """What a checkpoint of the identifier holds."""

    config: IdentifierParameters
    state: pipeline.State


class CheckpointWriter:
    """Writes the identifier's state to ``checkpoint_file`` every ``checkpoint_period``, on a thread.

    The rows of the sample log in a state are never changed, so the thread can save it while further samples come.
    """

    def __init__(self, config: IdentifierParameters) -> None:
        self._path = config.checkpoint_file
        self._period_s = config.checkpoint_period
        self._next_s = time.monotonic() + self._period_s
        self._thread: threading.Thread | None = None
        self._refused = False
        """Whether the file is one that could not be used."""
        self.saves = 0
        self.problem = ''
        """Why the last save failed; empty when it did not."""

    def load(self, config: IdentifierParameters) -> pipeline.State | None:
        """Return the saved state, None when there is no file.

        Raises CheckpointError for a file that cannot be read or was written with other parameters. The first save sets
        that aside.
        """
        self._refused = Path(self._path).exists()
        found = load(self._path)
        if found is None:
            return None
        if not isinstance(found, Saved):
            raise CheckpointError(f"checkpoint '{self._path}' holds no state of the identifier", _EMPTY_START)
        for name in changed(found.config, config):
            raise CheckpointError(
                f"parameter '{name}' has another value than when checkpoint '{self._path}' was written", _EMPTY_START)
        self._refused = False
        return pipeline.reconfigure(config, found.state)

    def save_when_due(self, config: IdentifierParameters, state: pipeline.State) -> None:
        """Save on a thread if ``checkpoint_period`` has passed and no save is under way."""
        if time.monotonic() < self._next_s or (self._thread is not None and self._thread.is_alive()):
            return
        self._next_s = time.monotonic() + self._period_s
        thread = threading.Thread(target=self.save, args=(config, state), name='checkpoint')
        thread.start()
        self._thread = thread

    def save(self, config: IdentifierParameters, state: pipeline.State) -> None:
        """Save now, but no state without a sample; a failure is kept in ``problem`` for the diagnostics.

        A file that could not be used is set aside as ``NAME.refused``: with the parameters of before it is good.
        """
        if not state.counters.accepted:
            return
        try:
            if self._refused:
                with suppress(OSError):  # else it is replaced
                    Path(self._path).replace(f'{self._path}.refused')
                self._refused = False
            save(self._path, Saved(config, state))
        except CheckpointError as error:
            self.problem = str(error)
        else:
            self.saves += 1
            self.problem = ''

    def join(self) -> None:
        """Wait for a save that is under way."""
        if self._thread is not None:
            self._thread.join()


def changed(before: IdentifierParameters, now: IdentifierParameters) -> list[str]:
    """Return the names of the parameters that differ and on which the state depends."""
    free = {leaf.name for leaf in leaves(IdentifierParameters) if leaf.live or leaf.name.startswith('checkpoint_')}
    old, new = flatten(before), flatten(now)
    return [name for name in new if name not in free and old.get(name) != new[name]]


def too_old(config: IdentifierParameters, state: pipeline.State, stamp_ns: int) -> bool:
    """Whether a sample is further than ``checkpoint_max_age`` from the last sample of a saved state."""
    return state.payload is not None and abs(stamp_ns - state.payload.last_ns) > config.checkpoint_max_age * 1e9
