# numba carries no types; with these, kernels keep their own signatures under mypy --strict.
from collections.abc import Callable
from typing import Any, TypeVar, overload

F = TypeVar('F', bound=Callable[..., Any])

@overload
def njit(function: F, /) -> F: ...
@overload
def njit(
    signature: Any = ...,
    /,
    *,
    cache: bool = ...,
    fastmath: bool = ...,
    nogil: bool = ...,
    inline: str = ...,
    boundscheck: bool = ...,
    error_model: str = ...,
    parallel: bool = ...,
) -> Callable[[F], F]: ...
def typeof(val: Any, purpose: Any = ..., /) -> Any: ...

types: Any
