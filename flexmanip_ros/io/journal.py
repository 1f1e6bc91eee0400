"""The journal of a study: one JSON line per run, on disk before the next run is added.

A study that was interrupted or killed continues from its journal. The table of the study (.csv or .parquet) is made
from the journal at the end, and on an interrupt.
"""

from __future__ import annotations

import fcntl
import importlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.io.outputs import OutputError, check_place, write_file, write_rows

Row = dict[str, Any]
SUFFIXES = ('.csv', '.parquet')


class Journal:
    """Rows of one study at ``path`` + '.journal'. Use it in a ``with``.

    identity: names and values that differ between studies. Raises OutputError for the journal of another study, for a
    damaged one, and for one that another process is writing.
    """

    def __init__(self, path: str | Path, identity: Mapping[str, Any]) -> None:
        self.path = Path(path)
        self.journal = self.path.with_name(self.path.name + '.journal')
        self.rows: list[Row] = []
        if self.path.suffix not in SUFFIXES:
            raise OutputError(f"'{path}' is neither .csv nor .parquet", 'end the name in one of them')
        if self.path.suffix == '.parquet':
            _parquet()
        check_place(self.path)
        head = json.dumps({'study': identity}, sort_keys=True)
        is_new = not self.journal.exists()
        if is_new and self.path.exists():
            raise OutputError(f"'{path}' exists already and has no journal to continue from",
                              'remove it or give another name')
        try:
            self._file = self.journal.open('a', encoding='utf-8')
        except OSError as err:
            raise OutputError(f"'{self.journal}' cannot be written: {err.strerror}", 'give another place') from err
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
            raise OutputError(f"'{self.journal}' is being written by another process",
                              'wait for it, or give another --output') from err
        except OSError:
            return  # this file system has no locks

    def _resume(self, head: str) -> bool:
        """Read the rows; drop an incomplete last line, as a kill leaves it. Return whether the first was complete."""
        content = self.journal.read_bytes()
        whole = content[:content.rfind(b'\n') + 1]
        if not whole and not f'{head}\n'.encode().startswith(content):
            raise OutputError(f"'{self.journal}' is no journal of a study", 'remove it, or give another --output')
        lines = whole.decode('utf-8', errors='replace').splitlines()
        if lines and lines[0] != head:
            raise OutputError(f"'{self.journal}' belongs to another study",
                              'give another --output, or remove the journal to start again')
        for place, line in enumerate(lines[1:], start=2):
            try:
                self.rows.extend(_run(line))
            except ValueError as err:
                raise OutputError(f"'{self.journal}' is damaged in line {place}: {err}",
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
            raise OutputError(f"'{self.journal}' cannot be written: {err.strerror}",
                              'free some space and start again; the study continues') from err

    def finish(self, order: Iterable[str]) -> None:
        """Write the table, sorted by the columns in ``order``."""
        names = list(order)
        rows = sorted(self.rows, key=lambda row: tuple(_sortable(row.get(name)) for name in names))
        if self.path.suffix == '.csv':
            write_rows(self.path, rows)
        else:
            arrow, parquet = _parquet()
            columns = dict.fromkeys(name for row in rows for name in row)
            made = arrow.table({name: [row.get(name) for row in rows] for name in columns})
            write_file(self.path, lambda file: parquet.write_table(made, file))

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._file.close()


def _run(line: str) -> list[Row]:
    """Return the rows in one line of the journal. Raises ValueError where it holds none."""
    found = json.loads(line)
    if not isinstance(found, list) or not all(isinstance(row, dict) for row in found):
        raise ValueError('it holds no rows')
    return found


def _sortable(value: Any) -> tuple[int, Any]:
    return (0, value) if isinstance(value, (int, float)) else (1, str(value))


def _parquet() -> tuple[Any, Any]:
    try:
        return importlib.import_module('pyarrow'), importlib.import_module('pyarrow.parquet')
    except ImportError as err:
        raise FlexmanipError('a .parquet table needs pyarrow, which is not installed',
                             "run 'pip install pyarrow', or end the name in .csv") from err
