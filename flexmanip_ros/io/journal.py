"""The rows of a study as they come: one JSON line each, on disk before the next; and the table made of them.

A study that was interrupted, or killed, continues from its journal. The table (.csv or .parquet) is written
from it at the end and on an interrupt.
"""

from __future__ import annotations

import csv
import importlib
import io
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.io.table import OutputError, check_place, write_file

Row = dict[str, Any]
SUFFIXES = ('.csv', '.parquet')


class Journal:
    """Rows of one study at ``path`` + '.journal'. Use it in a ``with``.

    identity: what makes the study this one; a journal of another study is refused with OutputError.
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
        if self.journal.exists():
            self._resume(head)
        elif self.path.exists():
            raise OutputError(f"'{path}' exists already and has no journal to continue from",
                              'remove it or give another name')
        self._file = self.journal.open('a', encoding='utf-8')
        if not self.rows and self.journal.stat().st_size == 0:
            self._append(head)

    def _resume(self, head: str) -> None:
        """Read what is there; a line that a kill tore is taken back."""
        content = self.journal.read_bytes()
        whole = content[:content.rfind(b'\n') + 1]
        if len(whole) < len(content):
            with self.journal.open('r+b') as file:
                file.truncate(len(whole))
        lines = whole.decode('utf-8').splitlines()
        if lines and lines[0] != head:
            raise OutputError(f"'{self.journal}' belongs to another study",
                              'give another --output, or remove the journal to start again')
        try:
            self.rows = [json.loads(line) for line in lines[1:]]
        except ValueError as err:
            raise OutputError(f"'{self.journal}' is damaged: {err}", 'remove it to start again') from err

    def add(self, rows: Iterable[Row]) -> None:
        """Keep the rows of one run, all or none."""
        kept = list(rows)
        self._append('\n'.join(json.dumps(row) for row in kept))
        self.rows.extend(kept)

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
        columns = list(dict.fromkeys(name for row in rows for name in row))
        if self.path.suffix == '.csv':
            text = io.StringIO()
            writer = csv.DictWriter(text, columns, restval='', lineterminator='\n')
            writer.writeheader()
            writer.writerows({name: '' if row[name] is None else row[name] for name in row} for row in rows)
            write_file(self.path, lambda file: file.write(text.getvalue().encode('utf-8')))
        else:
            arrow, parquet = _parquet()
            made = arrow.table({name: [row.get(name) for row in rows] for name in columns})
            write_file(self.path, lambda file: parquet.write_table(made, file))

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._file.close()


def _sortable(value: Any) -> tuple[int, Any]:
    return (0, value) if isinstance(value, (int, float)) else (1, str(value))


def _parquet() -> tuple[Any, Any]:
    try:
        return importlib.import_module('pyarrow'), importlib.import_module('pyarrow.parquet')
    except ImportError as err:
        raise FlexmanipError('a .parquet table needs pyarrow, which is not installed',
                             "run 'pip install pyarrow', or end the name in .csv") from err
