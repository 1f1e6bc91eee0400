"""A program tells once that kernels are being compiled, and only when a wait is felt."""

from __future__ import annotations

import multiprocessing

import pytest
from numba import njit
from numba.core import event

from flexmanip_ros.cli import console


def compile_something() -> None:
    """Compile a function that numba has not seen."""
    @njit
    def new(x: float) -> float:
        return x + 1.0

    assert new(1.0) == 2.0


def test_it_is_told_once_however_many_kernels_are_compiled(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(console, 'PATIENCE', 1e-4)
    with console.announced():
        compile_something()
        compile_something()
    said = capsys.readouterr()
    assert said.err.splitlines() == [console.COMPILING]
    assert said.out == ''  # which belongs to the results


def test_a_short_compilation_is_not_worth_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(console, 'PATIENCE', 120.0)
    with console.announced():
        compile_something()
    assert capsys.readouterr().err == ''


def test_what_is_compiled_already_is_not_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(console, 'PATIENCE', 1e-4)
    with console.announced():
        pass
    compile_something()  # after the program has ended
    assert capsys.readouterr().err == ''


def test_of_many_workers_one_speaks(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(console, 'PATIENCE', 1e-4)
    turn = multiprocessing.get_context('spawn').Lock()
    before = list(event._registered['numba:compile'])
    try:
        console.announce_in_worker(turn)
        console.announce_in_worker(turn)
        compile_something()
    finally:
        event._registered['numba:compile'][:] = before
    assert capsys.readouterr().err.splitlines() == [console.COMPILING]
