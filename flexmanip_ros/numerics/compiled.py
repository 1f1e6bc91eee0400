"""How the inner functions are compiled (numba): no fast-math, so that every machine gets the same bits.

Compiled functions are cached on disk at first use; those that are older than the sources are deleted at import.
"""

import contextlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from numba import njit, typeof
from numba.extending import register_jitable

Function = TypeVar('Function', bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function that only reads and writes the arrays it is given.

    Reference counting is off (numba's ``_nrt``): the counters of some thirty arrays in a Manipulator
    cost more than the arithmetic (1.5 us against 0.4 us an evaluation at kappa = 1). Hence a kernel
    must not create arrays or return them; callers compiled normally may.
    """
    return _compiled(function)


def inlined(function: Function) -> Function:
    """Compile a kernel into those that call it; Python may call it as well.

    Passing a Manipulator takes some 300 words on the stack and as many instructions at every call: half the
    time of the small kernels. Every caller compiles the function again, so a function with few callers and a long
    run time stays a ``kernel``.
    """
    return _compiled(function, forceinline=True)


def inner(function: Function) -> Function:
    """Compile a function into the kernels that call it, and nowhere else; Python runs it as it is written.

    There is no code that unpacks arguments from Python, which takes longer to compile than a short function itself.
    """
    made: Function = register_jitable(forceinline=True, **_OPTIONS)(function)
    return made


def merged(function: Function) -> Function:
    """Put the text of a function into the one kernel that calls it, before anything is compiled.

    The compiler optimizes all that a function calls once more with each of its callers, so the callers of the equations
    of motion are merged into one function. Each merge copies the whole text, so a function that calls no kernel is
    ``inner`` instead.
    """
    return _compiled(function, inline='always')


def library(function: Function) -> Function:
    """Compile a function that kernels call and that calls BLAS through NumPy's linear algebra.

    Reference counting is on, because numba requires it there.
    """
    counted: dict[str, Any] = {'_nrt': True, 'forceinline': False}
    compiled: Function = njit(cache=True, nogil=True, **counted)(function)
    return compiled


def compile_for(function: Callable[..., Any], *values: Any) -> None:
    """Compile a kernel for arguments of the types of these values, without running it."""
    compiled: Any = function
    compiled.compile(tuple(typeof(value) for value in values))


_OPTIONS: dict[str, Any] = {'nogil': True, '_nrt': False, 'no_cfunc_wrapper': True}
"""Options of numba. There is no wrapper for callbacks from C, which would unpack all arguments once more."""


def _compiled(function: Function, **more: Any) -> Function:
    compiled: Function = njit(cache=True, **_OPTIONS, **more)(function)
    return compiled


COMPILED = re.compile(r'^@(kernel|inlined|inner|merged|library)$', re.MULTILINE)
IMPORT = re.compile(r'^ *from ([\w.]+) import (\([^)]*\)|.*)$', re.MULTILINE)
CONSTANT = re.compile(r'\b[A-Z][A-Z_]+\b')


def drop_stale(package: Path) -> int:
    """Delete cached functions that are older than the newest source of any compiled function; return how many.

    numba checks the file of a function alone, not those of the functions it calls or of the constants it reads. After
    an update one kernel in two would be outdated, and its numbers wrong. Raises OSError where the folder is
    read-only.
    """
    compiled = {path: path.stat().st_mtime_ns for path in package.rglob('__pycache__/*.nb[ic]')}
    oldest = min(compiled.values(), default=0)
    changed = {path: age for path in package.rglob('*.py') if compiled and (age := path.stat().st_mtime_ns) > oldest}
    # most imports read no file
    newest = max((changed[path] for path in _sources(package) & changed.keys()), default=0) if changed else 0
    stale = [path for path, age in compiled.items() if age < newest]
    for path in stale:
        path.unlink(missing_ok=True)
    return len(stale)


def _sources(package: Path) -> set[Path]:
    """Return the files of compiled functions, and those of which they import constants."""
    texts = {path: path.read_text(encoding='utf-8') for path in package.rglob('*.py')}
    found = {path: text for path, text in texts.items() if COMPILED.search(text)}
    imported = (module for text in found.values() for module, names in IMPORT.findall(text) if CONSTANT.search(names))
    modules = {package.parent / f'{module.replace(".", "/")}.py' for module in imported}
    return found.keys() | (modules & texts.keys())


with contextlib.suppress(OSError):  # numba keeps those of a read-only folder elsewhere
    drop_stale(Path(__file__).parents[1])
