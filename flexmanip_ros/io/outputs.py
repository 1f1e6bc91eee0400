"""Files of results: written whole or not at all, as tables of estimates, as recordings of them, or as a study's table.

A table of estimates (.csv for people and spreadsheets, .npz with the matrices for numpy) is written at the end of a
run; a recording grows with the run. A study has a journal: one JSON line per run, on disk before the next run is added.
A study that was interrupted or killed continues from its journal. Its table (.csv) is made from the journal
at the end, and on an interrupt.
"""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import stat
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flexmanip_ros.errors import BagError, FlexmanipError
from flexmanip_ros.messages import LATCHED, outgoing
from flexmanip_ros.types import Array, Estimate

if TYPE_CHECKING:
    from flexmanip_ros.io.bag_writer import BagWriter

PAYLOAD = ('mass', 'std', 'lower', 'upper', 'consistency')
SCALARS = ('excitation', 'condition', 'innovation_power')
NODE = 'rpbsid_identifier'
LEAST_MODES = 2
TABLES = ('.csv', '.npz')
"""Endings of the names of tables of estimates."""


def write_file(path: str | Path, fill: Callable[[Any], Any]) -> None:
    """Write a file whole or not at all; an older one stays until the new one is complete."""
    path = Path(path)
    partial = path.parent / f'.{path.name}.part'
    try:
        with partial.open('wb') as file:
            fill(file)
        os.replace(partial, path)
    except BaseException as err:
        with suppress(OSError):  # a name may be too long for it
            partial.unlink()
        if not isinstance(err, OSError):  # an interrupt
            raise
        raise FlexmanipError(f"'{path}' cannot be written: {err.strerror}", 'give another place') from err


def ending(path: str | Path) -> str:
    """Return the ending of a name with its point, in lower case."""
    return Path(path).suffix.lower()


def check_place(path: str | Path, *endings: str) -> None:
    """Raise FlexmanipError when a file cannot be written there, or its name has none of the endings, if any are given.

    Call it before a long run.
    """
    folder = Path(path).absolute().parent
    try:
        is_directory = stat.S_ISDIR(os.stat(path).st_mode)
    except (FileNotFoundError, NotADirectoryError):
        is_directory = not str(path)
    except OSError as err:
        raise FlexmanipError(f"'{path}' cannot be written: {err.strerror}", 'give another place') from err
    if is_directory:
        raise FlexmanipError(f"'{path}' is a directory", 'give a file name')
    if not folder.is_dir():
        raise FlexmanipError(f"directory '{folder}' does not exist", 'make it first, or give another place')
    if not os.access(folder, os.W_OK):
        raise FlexmanipError(f"directory '{folder}' cannot be written", 'give another place')
    if endings and ending(path) not in endings:
        raise FlexmanipError(f"'{path}' does not end in {' or '.join(endings)}", 'give such a name')


def check_apart(outputs: Mapping[str, str | None], params: str | None, bag: str | None = None) -> None:
    """Raise FlexmanipError where a run would write over what it reads, or write two outputs to one place.

    outputs: path of each option, None where it is not given; params: the parameter file that is read; bag: the
    recording that is read, in whose folder no output may be.
    """
    taken: dict[Path, str] = {}
    folder = None if bag is None else Path(bag).resolve()
    if folder is not None and (folder.parent / 'metadata.yaml').is_file():  # one file of a recording
        folder = folder.parent
    for option, given in outputs.items():
        if not given:
            continue
        path = Path(given).resolve()
        if params is not None and path == Path(params).resolve():
            raise FlexmanipError(f"{option} would overwrite '{given}', which --params reads", 'give another name')
        if folder is not None and path.is_relative_to(folder):
            raise FlexmanipError(f"{option} '{given}' is in the recording '{bag}'", 'give a place outside of it')
        if path in taken:
            raise FlexmanipError(f"{taken[path]} and {option} are both '{given}'", 'give two names')
        taken[path] = option


def write_text(path: str | Path, text: str) -> None:
    """Write a text file as UTF-8, whole or not at all."""
    data = text.encode('utf-8', 'backslashreplace')  # a name of a file need not be UTF-8
    write_file(path, lambda file: file.write(data))


def write_rows(path: str | Path, rows: Sequence[Mapping[str, Any]], names: Iterable[str] = ()) -> None:
    """Write rows of named values as .csv; a value that is None or not there is an empty cell. names: first columns."""
    text = io.StringIO()
    every = dict.fromkeys((*names, *(name for row in rows for name in row)))
    writer = csv.DictWriter(text, list(every), restval='', lineterminator='\n')
    writer.writeheader()
    writer.writerows({name: '' if value is None else value for name, value in row.items()} for row in rows)
    write_text(path, text.getvalue())


def columns(estimates: Sequence[Estimate], start_ns: int | None = None) -> dict[str, Any]:
    """Return arrays with one row for each estimate.

    stamp_ns (T,), time_s (T,) from ``start_ns`` (default: the first estimate), status, model_status (T,), frequency_hz,
    damping_ratio and their _std (T, k), payload_mass_kg, payload_std_kg, payload_lower_kg, payload_upper_kg,
    consistency, excitation, condition, innovation_power (T,). Values that an estimate does not have are NaN.
    """
    stamps = np.array([estimate.stamp_ns for estimate in estimates], dtype=np.int64)
    start = start_ns if start_ns is not None else next(iter(stamps), 0)
    count = max((len(estimate.modes) for estimate in estimates), default=0)
    modes = np.full((len(estimates), count, 4), np.nan)
    payload = np.full((len(estimates), len(PAYLOAD)), np.nan)
    for row, estimate in enumerate(estimates):
        if estimate.modes:
            modes[row, :len(estimate.modes)] = estimate.modes
        if estimate.payload is not None:
            payload[row] = [getattr(estimate.payload, name) for name in PAYLOAD]
    found: dict[str, Any] = {
        'stamp_ns': stamps,
        'time_s': (stamps - start) * 1e-9,
        'status': np.array([estimate.status.name for estimate in estimates], dtype=np.str_),
        'model_status': np.array([estimate.model_status.name for estimate in estimates], dtype=np.str_),
        'frequency_hz': modes[:, :, 0], 'damping_ratio': modes[:, :, 1],
        'frequency_std_hz': modes[:, :, 2], 'damping_ratio_std': modes[:, :, 3],
        'payload_mass_kg': payload[:, 0], 'payload_std_kg': payload[:, 1],
        'payload_lower_kg': payload[:, 2], 'payload_upper_kg': payload[:, 3], 'consistency': payload[:, 4],
    }
    for name in SCALARS:
        found[name] = np.array([getattr(estimate, name) for estimate in estimates], dtype=np.float64)
    return found


def matrices(estimates: Sequence[Estimate]) -> dict[str, Array]:
    """Return A (T, n, n), B, C, D, K and dt (T,); rows without a model are NaN. Empty without any model.

    n is the largest order in the run. A model of a smaller order fills the upper left part, the rest is NaN.
    """
    models = [estimate.model for estimate in estimates]
    if not any(models):
        return {}
    found = {name: _padded([None if model is None else getattr(model, name) for model in models]) for name in 'ABCDK'}
    return {**found, 'dt': np.array([np.nan if model is None else model.dt for model in models])}


def _padded(parts: Sequence[Array | None]) -> Array:
    """Return matrices as one array, each in the upper left of a largest one; what is missing is NaN."""
    shape = np.max([part.shape for part in parts if part is not None], axis=0)
    table = np.full((len(parts), *shape), np.nan)
    for row, part in enumerate(parts):
        if part is not None:
            table[row, :part.shape[0], :part.shape[1]] = part
    return table


def write_table(path: str | Path, estimates: Sequence[Estimate], start_ns: int | None = None) -> None:
    """Write columns and matrices as numpy arrays (.npz, nothing pickled), or a line for each estimate (.csv).

    In the lines, columns of several modes are numbered from 1, and NaN is an empty cell. There are columns of
    ``LEAST_MODES`` modes at least, so that a script finds them whatever the recording gave.
    """
    found = columns(estimates, start_ns)
    if ending(path) == '.npz':
        found |= matrices(estimates)
        write_file(path, lambda file: np.savez_compressed(file, **found))
        return
    flat: dict[str, Any] = {}
    for name, values in found.items():
        if values.ndim == 2:
            stem, _, unit = name.partition('_')
            none = np.full((len(values), max(LEAST_MODES - values.shape[1], 0)), np.nan)
            flat |= {f'{stem}{k + 1}_{unit}': column for k, column in enumerate(np.hstack([values, none]).T)}
        else:
            flat[name] = values
    rows = ({name: _cell(values[row]) for name, values in flat.items()} for row in range(len(estimates)))
    write_rows(path, list(rows), flat)


def _cell(value: Any) -> Any:
    """Return an element of an array as a plain value, None for NaN."""
    return None if isinstance(value, np.floating) and np.isnan(value) else value.item()


def check_output(path: str | Path) -> None:
    """Raise FlexmanipError where ``Output`` cannot write, or would write over a recording."""
    if ending(path) not in TABLES and os.path.exists(path):  # check_place names what is wrong with a name too long
        raise BagError(f"'{path}' exists already", 'remove it or give another name')
    check_place(path)


class Output:
    """Takes estimates one by one: a table where the name ends in .csv or .npz, else a recording.

    A table is written when it is closed. A recording has the stamps of the input and grows from the first estimate on.
    Use it in a ``with``, which closes it; after an exception only if it is not empty.
    """

    def __init__(self, path: str | Path, frame_id: str) -> None:
        self.path = Path(path)
        self.start_ns: int | None = None
        """Stamp at which the time of a table is 0; None: the first estimate."""
        self._frame_id = frame_id
        self._is_table = ending(path) in TABLES
        self._estimates: list[Estimate] = []
        """Rows of the table."""
        self._writer: BagWriter | None = None
        check_output(path)

    def write(self, estimate: Estimate) -> None:
        """Keep one estimate as a row of the table, or append the messages that the node would have published."""
        if self._is_table:
            self._estimates.append(estimate)
            return
        writer = self._opened()
        for name, value in outgoing(estimate, self._frame_id):
            recorded_ns = max(estimate.stamp_ns, 0)  # unlike a stamp it has no sign in a recording
            writer.write(f'/{NODE}/{name}', recorded_ns, value, latched=name in LATCHED)

    def _opened(self) -> BagWriter:
        if self._writer is None:
            from flexmanip_ros.io.bag_writer import BagWriter  # a program that writes no recording needs no rosbags

            self._writer = BagWriter(self.path)
        return self._writer

    def __enter__(self) -> Output:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None and not self._estimates and self._writer is None:
            return
        if self._is_table:
            write_table(self.path, self._estimates, self.start_ns)
        else:
            self._opened().close()


Row = dict[str, Any]


class Journal:
    """Rows of one study at ``path`` + '.journal'. Use it in a ``with``.

    identity: names and values that differ between studies. Raises FlexmanipError for the journal of another study, for
    a damaged one, and for one that another process is writing.
    """

    def __init__(self, path: str | Path, identity: Mapping[str, Any]) -> None:
        check_place(path, '.csv')
        self.path = Path(path)
        self.journal = self.path.with_name(self.path.name + '.journal')
        self.rows: list[Row] = []
        head = json.dumps({'study': identity}, sort_keys=True)
        is_new = not self.journal.exists()
        if is_new and self.path.exists():
            raise FlexmanipError(f"'{path}' exists already and has no journal to continue from",
                                 'remove it or give another name')
        try:
            self._file = self.journal.open('a', encoding='utf-8')
        except OSError as err:
            raise FlexmanipError(f"'{self.journal}' cannot be written: {err.strerror}", 'give another place') from err
        try:
            self._lock()
            if is_new or not self._resume(head):
                self._append(head)
        except BaseException:
            self._file.close()
            raise

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as err:
            raise FlexmanipError(f"'{self.journal}' is being written by another process",
                                 'wait for it, or give another --output') from err
        except OSError:
            return  # this file system has no locks

    def _resume(self, head: str) -> bool:
        """Read the rows; drop an incomplete last line, left by a kill. Return whether the first line was complete."""
        content = self.journal.read_bytes()
        whole = content[:content.rfind(b'\n') + 1]
        if not whole and not f'{head}\n'.encode().startswith(content):
            raise FlexmanipError(f"'{self.journal}' is no journal of a study", 'remove it, or give another --output')
        lines = whole.decode('utf-8', errors='replace').splitlines()
        if lines and lines[0] != head:
            raise FlexmanipError(f"'{self.journal}' belongs to another study",
                                 'give another --output, or remove the journal to start again')
        for place, line in enumerate(lines[1:], start=2):
            try:
                self.rows.extend(_run(line))
            except ValueError as err:
                raise FlexmanipError(f"'{self.journal}' is damaged in line {place}: {err}",
                                     'remove that line, its run is done again') from err
        if len(whole) < len(content):
            self._file.truncate(len(whole))
        return bool(lines)

    def add(self, rows: Iterable[Row]) -> None:
        """Add the rows of one run: all of them or, after an error, none."""
        kept = list(rows)
        line = json.dumps(kept)
        self.rows.extend(kept)  # before the file: after an interrupt while writing, the table still has the run
        self._append(line)

    def _append(self, text: str) -> None:
        try:
            self._file.write(text + '\n')
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as err:
            raise FlexmanipError(f"'{self.journal}' cannot be written: {err.strerror}",
                                 'free some space and start again; the study continues') from err

    def finish(self, order: Iterable[str]) -> None:
        """Write the table, sorted by the columns in ``order``."""
        names = list(order)
        rows = sorted(self.rows, key=lambda row: tuple(_sortable(row.get(name)) for name in names))
        write_rows(self.path, rows)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()


def _run(line: str) -> list[Row]:
    """Return the rows in one line of the journal. Raises ValueError where it holds none."""
    found = json.loads(line)
    if not isinstance(found, list) or not all(isinstance(row, dict) for row in found):
        raise ValueError('it holds no rows')
    return found


def _sortable(value: Any) -> tuple[int, Any]:
    return (0, value) if isinstance(value, (int, float)) else (1, str(value))
