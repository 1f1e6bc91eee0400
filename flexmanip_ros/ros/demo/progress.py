"""Where the demonstration is, on the terminal."""

from __future__ import annotations

import time

from rich.console import Console

from flexmanip_ros.ros.demo.composition import Composition


class Progress:
    """A line a second, or a bar that moves where the output is a terminal."""

    def __init__(self, console: Console, composition: Composition) -> None:
        self._console = console
        self._composition = composition
        self._period = 0.1 if console.is_terminal else 1.0
        self._next = time.monotonic() + self._period

    def update(self) -> bool:
        """Show where the run is; True when it is over. Called after every callback, so it is cheap."""
        if self._composition.finished:
            return True
        now = time.monotonic()
        if now >= self._next:
            self._next = now + self._period
            self._show()
        return False

    def end(self) -> None:
        """Show the last state."""
        self._show()
        if self._console.is_terminal:
            self._console.print()

    def _show(self) -> None:
        line = f'{self._composition.elapsed:5.1f} / {self._composition.config.duration:.1f} s  ' \
               + self._bar() + '  ' + self._words()
        if self._console.is_terminal:
            self._console.print('\r' + line.ljust(self._console.width - 1)[:self._console.width - 1], end='')
        else:
            self._console.print(line)

    def _bar(self) -> str:
        done = min(int(self._composition.elapsed / self._composition.config.duration * 24), 24)
        return '#' * done + '.' * (24 - done)

    def _words(self) -> str:
        estimate = self._composition.identifier.estimate
        if estimate is None:
            return 'warming up'
        words = [' '.join(f'{mode.frequency_hz:.2f}' for mode in estimate.modes[:2]) + ' Hz'] \
            if estimate.modes else []
        told = self._composition.trigger.announced.latest
        if told is not None:
            words.append(told.kind.value)
        if estimate.payload is not None:
            words.append(f'payload {estimate.payload.mass:.2f} +- {estimate.payload.std:.2g} kg')
        return ', '.join(words)
