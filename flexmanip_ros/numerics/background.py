"""Long computations: requested at one sample, with the result used a fixed number of samples later.

A fit or the computation of a model takes longer than the time between samples. The core describes the work as a
request, a value with a pure ``solve``, and takes the result at a later sample that depends on stamps alone. So
the numbers do not depend on the thread that solved the request, nor on when it was ready.
"""

from collections.abc import Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol, TypeVar


class Request(Protocol):
    """A computation that depends on nothing but its own fields."""

    def solve(self) -> Any:
        """Compute the result."""


class Inline:
    """Solves each request when its result is wanted, on the caller's thread."""

    def start(self, request: Request) -> None:
        """Do nothing until the result is wanted."""

    def result(self, request: Request) -> Any:
        """Solve the request."""
        return request.solve()


INLINE = Inline()

THREADS = 2
"""Threads: one for a fit, which takes up to a second, one for the models computed meanwhile, each in 1 to 3 ms."""
REPLAY_THREADS = 3
"""Threads of a replay: one more, for the payload."""
NAME = 'background'
"""First letters of the names of these threads."""
KEPT = 8
"""Number of requests kept with their results after these were taken. A late event rewinds the estimator by 0.2 s and
needs the results of that time again: at most a fit and, where every estimate has a model of its own, the models of the
last few estimates."""


class Threads:
    """Solves requests on other threads, with the same bits as ``INLINE``. A node or a program owns it, not the core."""

    def __init__(self, threads: int = THREADS) -> None:
        self._pool = ThreadPoolExecutor(threads, NAME)
        self._awaited: dict[Request, Future[Any]] = {}
        self._taken: dict[Request, Future[Any]] = {}
        self._closed = False

    def start(self, request: Request) -> None:
        """Begin to solve a request; after ``close`` do nothing.

        A request that nobody waits for any more, as after a rewind, is dropped when ``KEPT`` newer ones are awaited.
        """
        if self._closed:
            return
        self._awaited[request] = self._pool.submit(request.solve)
        if len(self._awaited) > KEPT:
            oldest = (known for known, future in self._awaited.items() if future.done() or future.cancel())
            self._awaited.pop(next(oldest))

    def result(self, request: Request) -> Any:
        """Return the result of a request: wait for the thread that solves it, or solve it here if none does yet."""
        future = self._awaited.pop(request, None) or self._taken.get(request)
        if future is None or future.cancel():
            return request.solve()
        self._taken[request] = future
        if len(self._taken) > KEPT:
            self._taken.pop(next(iter(self._taken)))
        return future.result()

    def close(self, wait: bool = True) -> None:
        """Drop every request; wait for those that are being solved. Later requests are solved by ``result``.

        wait: False does not wait for them, as a kernel may run for seconds and cannot be stopped.
        """
        if self._closed:
            return
        self._closed = True
        self._awaited.clear()
        self._taken.clear()
        self._pool.shutdown(wait, cancel_futures=True)


class Deferred(Threads):
    """Solves requests from ``begin`` on: a node calls it after it publishes an estimate, so that no estimate waits.

    Python runs one thread at a time, and another thread waits up to 5 ms for its turn.
    """

    def __init__(self) -> None:
        super().__init__()
        self._waiting: list[Request] = []

    def start(self, request: Request) -> None:
        """Take note of a request."""
        self._waiting.append(request)

    def begin(self) -> None:
        """Begin to solve the requests noted."""
        waiting, self._waiting = self._waiting, []
        for request in waiting:
            super().start(request)

    def result(self, request: Request) -> Any:
        """Return the result of a request."""
        self.begin()
        return super().result(request)


Background = Inline | Threads
"""Where requests are solved: ``start`` says that the result of one will be wanted, ``result`` returns it."""
T = TypeVar('T')


def read_ahead(items: Iterable[T]) -> Generator[T]:
    """Yield items; a thread computes the next item while the caller uses the present one."""
    stream, end = iter(items), object()
    with ThreadPoolExecutor(1, 'ahead') as pool:
        coming = pool.submit(next, stream, end)
        while (item := coming.result()) is not end:
            coming = pool.submit(next, stream, end)
            yield item  # type: ignore[misc]
