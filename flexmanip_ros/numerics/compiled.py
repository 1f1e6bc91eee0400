"""How the inner functions are compiled (numba): no fast-math, so that every machine gets the same bits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Function = TypeVar('Function', bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function that only reads and writes the arrays it is given.

    Reference counting is off (numba's ``_nrt``): the counters of some thirty arrays in a Manipulator
    cost more than the arithmetic (1.5 us against 0.4 us an evaluation at kappa = 1). Hence a kernel
    must not create arrays or return them; callers compiled normally may.
    """
    return _compiled(function)


def inlined(function: Function) -> Function:
    """Compile a kernel into those that call it.

    Passing a Manipulator takes some 300 words on the stack and as many instructions at every call: half the
    time of the small kernels. Every caller compiles it again, so what is called in few places and works long stays
    a ``kernel``.
    """
    return _compiled(function, forceinline=True)


def merged(function: Function) -> Function:
    """Compile the body of a kernel as a part of the one or two functions that call it.

    The compiler optimizes all that a function calls once more with each function above it: four short functions above
    the equations of motion took 26 s to compile, as parts of one function 8 s.
    """
    return _compiled(function, inline='always')


def _compiled(function: Function, **more: Any) -> Function:
    options: dict[str, Any] = {'cache': True, 'nogil': True, '_nrt': False, **more}
    compiled: Function = njit(**options)(function)
    return compiled
