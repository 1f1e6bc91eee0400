"""Long computations: asked for at one sample, their result taken a fixed number of samples later.

A fit or the reading of a model takes longer than the time between two samples. The core describes the work as a
request, a value with a pure ``solve``, and takes the result at a later sample that depends on stamps alone. So
the numbers do not depend on the thread that solved the request, nor on when it was ready.
"""

from __future__ import annotations

from typing import Any, Protocol


class Request(Protocol):
    """A computation that depends on nothing but its own fields."""

    def solve(self) -> Any:
        """Compute the result."""


class Background(Protocol):
    """Where requests are solved."""

    def start(self, request: Request) -> None:
        """Take note that the result of this request will be wanted."""

    def result(self, request: Request) -> Any:
        """Return the result of a request, solved now if it has not been solved yet."""


class Inline:
    """Solves each request when its result is wanted, on the caller's thread."""

    def start(self, request: Request) -> None:
        """Do nothing until the result is wanted."""

    def result(self, request: Request) -> Any:
        """Solve the request."""
        return request.solve()


INLINE = Inline()
