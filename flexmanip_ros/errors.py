"""Errors a user can meet. Each says what is wrong and what to do next."""

from __future__ import annotations


class FlexmanipError(Exception):
    """Root of every error this package raises on purpose.

    ``str(error)`` is one line: the thing that is wrong, then the way out.
    """

    def __init__(self, problem: str, remedy: str) -> None:
        self.problem = ' '.join(problem.split())
        self.remedy = ' '.join(remedy.split())
        super().__init__(f'{self.problem}; {self.remedy}')

    def __reduce__(self) -> tuple[type[FlexmanipError], tuple[str, str]]:
        """Survive pickling, so that a worker process can hand its error back."""
        return type(self), (self.problem, self.remedy)


class ParameterError(FlexmanipError):
    """A parameter is unknown, of the wrong type, out of range or at odds with another."""


class SignalError(FlexmanipError):
    """A configured signal is not in the data, or arrays have unequal sizes."""


class MissingSignalError(SignalError):
    """No message carries a configured signal."""


class BagError(FlexmanipError):
    """A bag is missing, empty, truncated, of the wrong type, or cannot be written."""


class CheckpointError(FlexmanipError):
    """A saved state cannot be used: damaged, of another version, or of other parameters."""


class ModelError(FlexmanipError):
    """A model cannot be built or solved (shapes, rank, divergence)."""
