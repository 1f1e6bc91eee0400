"""How the inner functions are compiled (numba): no fast-math, so that every machine gets the same bits.

Compiled functions are cached on disk at first use; those that are older than the sources are deleted at import.
"""

import contextlib
import hashlib
import importlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from numba import njit, typeof, types
from numba._dynfunc import make_function
from numba.core import cgutils
from numba.core.codegen import JITCodeLibrary, ll
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.datamodel.models import PrimitiveModel
from numba.core.datamodel.registry import register_default
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, register_jitable

Function = TypeVar('Function', bound=Callable[..., Any])
Types = tuple[Any, ...]
"""numba's types of the arguments of a function."""


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
    time of the small kernels. Every caller compiles the function again, so one that takes seconds to compile is
    ``separate``.
    """
    return _compiled(function, forceinline=True)


def inner(function: Function) -> Function:
    """Compile a function into the kernels that call it, and nowhere else; Python runs it as it is written."""
    made: Function = register_jitable(pipeline_class=_Inner, forceinline=True, **_OPTIONS)(function)
    return made


def library(function: Function) -> Function:
    """Compile a function that makes arrays, or calls BLAS through NumPy's linear algebra.

    Reference counting is on, as both need it.
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


class _Text(JITCodeLibrary):
    """LLVM's text of an ``inner`` function.

    numba optimizes each function with all that it calls and makes machine code of it, although its callers take the
    text. Both are left out here: they are done once, with the kernels that the text is linked into.
    """

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _Whole(types.Type):
    """The type of an argument that is passed as one value of LLVM's, whatever it holds.

    numba passes each number of an argument for itself. An ``inner`` function of a filter took some 700, and three in
    five instructions took tuples apart and put them together.
    """

    def __init__(self, of: Any) -> None:
        self.of = of
        super().__init__(f'whole {of.name}')


@register_default(_Whole)
class _WholeModel(PrimitiveModel):
    """Its representation: that of the value in a function."""

    def __init__(self, models: Any, whole: _Whole) -> None:
        super().__init__(models, whole, models.lookup(whole.of).get_value_type())


class _LowerWhole(Lower):
    """Lowers a function whose arguments are passed whole."""

    def __init__(self, context: Any, library: Any, described: Any, *rest: Any, **named: Any) -> None:
        described.argtypes = tuple(_Whole(argument) for argument in described.argtypes)
        super().__init__(context, library, described, *rest, **named)


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerToText(NativeLowering):
    """The pass in which numba makes machine code of a function, without that."""

    _name = 'lower_to_text'
    lowering_class = _LowerWhole

    def run_pass(self, state: Any) -> bool:
        """Write LLVM's text. Callers find it by an object that stands for the compiled function and must not be run."""
        flags, context = state.flags, state.targetctx
        state.library = _Text(context.codegen(), state.func_id.func_qualname)
        state.flags = flags.copy()  # numba has them in the keys of a dictionary
        state.flags.no_compile = True
        super().run_pass(state)
        state.flags, made = flags, state.cr
        known = make_function(made.fndesc.lookup_module(), made.fndesc.qualname, '', 0, made.env, (state.library,))
        whole = made.fndesc.argtypes  # a call is found by the plain types, and passes its arguments whole
        made.fndesc.argtypes = tuple(argument.of for argument in whole)
        context.insert_user_function(known, made.fndesc, [state.library])
        made.fndesc.argtypes = whole
        state.cr = made._replace(cfunc=known)
        return True


class _Inner(CompilerBase):
    """How numba compiles an ``inner`` function."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's passes, one of which is our own."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [(_LowerToText if one is NativeLowering else one, name) for one, name in passes.passes]
        passes.finalize()
        return [passes]


class Separate:
    """A kernel that is compiled once: the kernels that call it call its machine code.

    numba compiles a kernel again within each kernel that calls it. Here a caller refers to a symbol, which LLVM looks
    up in its table of the process when it links the caller. So the kernel must be compiled, or loaded from the cache,
    before its callers are linked. Compiling a caller compiles it; loading a caller loads it (``_Needed``).
    """

    def __init__(self, function: Callable[..., Any], *, from_python: bool) -> None:
        self.kernel: Any = _compiled(function, no_cpython_wrapper=not from_python)
        self._run = self.kernel if from_python else function
        self.__name__, self.__doc__, self.__module__ = function.__name__, function.__doc__, function.__module__
        calls = type(f'calls_of_{self.__name__}', (AbstractTemplate,),
                     {'key': self, 'generic': lambda _, arguments, named: self._typed(arguments)})
        infer_global(self, types.Function(calls))
        lower_builtin(self, types.VarArg(types.Any))(self._call)

    def __call__(self, *arguments: Any) -> Any:
        """Run it, called from Python."""
        return self._run(*arguments)

    def compile(self, arguments: Types) -> Any:
        """Compile it for arguments of these types, and define its symbol; return the type of its result."""
        self.kernel.compile(arguments)
        made = self.kernel.overloads[arguments]
        ll.add_symbol(self._symbol(arguments), made.library.get_pointer_to_function(made.fndesc.llvm_func_name))
        return made.signature.return_type

    def _symbol(self, arguments: Types) -> str:
        digest = hashlib.sha256(repr(arguments).encode()).hexdigest()[:16]
        return f'{self.__module__}.{self.__name__}.{digest}'

    def _typed(self, arguments: Types) -> Any:
        """Return the signature of a call with arguments of these types."""
        plain = tuple(types.unliteral(argument) for argument in arguments)
        return signature(self.compile(plain), *plain)

    def _call(self, context: Any, builder: Any, typed: Any, values: Any) -> Any:
        """Write the call into its caller, in LLVM's language and with numba's calling convention."""
        context.environment.consts.append(_Needed(self.__module__, self.__name__, typed.args))
        form = context.call_conv.get_function_type(typed.return_type, typed.args)
        target = cgutils.get_or_insert_function(builder.module, form, self._symbol(typed.args))
        _, result = context.call_conv.call_function(builder, target, typed.return_type, typed.args, values)
        return result


class _Needed:
    """A constant of a kernel that calls a separate one. Reading it from the cache loads the one that is called."""

    def __init__(self, module: str, name: str, arguments: Types) -> None:
        self.called = module, name, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return _load, self.called


def _load(module: str, name: str, arguments: Types) -> _Needed:
    getattr(importlib.import_module(module), name).compile(arguments)
    return _Needed(module, name, arguments)


def separate(function: Function) -> Function:
    """Compile a kernel once, for all kernels that call it; Python runs it as it is written.

    For kernels that take seconds to compile and microseconds to run. They must raise nothing, as their callers do not
    look for it.
    """
    made: Any = Separate(function, from_python=False)
    called: Function = made
    return called


def separate_kernel(function: Function) -> Function:
    """Compile a separate kernel that Python calls as well."""
    made: Any = Separate(function, from_python=True)
    called: Function = made
    return called


COMPILED = re.compile(r'^@(kernel|separate|separate_kernel|inlined|inner|library)$', re.MULTILINE)
IMPORT = re.compile(r'^ *from ([\w.]+) import (\([^)]*\)|.*)$', re.MULTILINE)
CONSTANT = re.compile(r'\b[A-Z][A-Z_]+\b')


def drop_stale(package: Path) -> int:
    """Delete cached functions that are older than the newest file that one of them may depend on; return how many.

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
    """Return the files of compiled functions, those that they import whole or constants of, and this one."""
    texts = {path: path.read_text(encoding='utf-8') for path in package.rglob('*.py')}
    found = {path: text for path, text in texts.items() if COMPILED.search(text)}
    imported = set[str]()
    for text in found.values():
        for module, names in IMPORT.findall(text):
            imported |= {f'{module}.{name}' for name in re.findall(r'\w+', names)}
            imported |= {module} if CONSTANT.search(names) else set()
    modules = {package.parent / f'{module.replace(".", "/")}.py' for module in imported}
    return found.keys() | (modules & texts.keys()) | {Path(__file__)}


with contextlib.suppress(OSError):  # numba keeps those of a read-only folder elsewhere
    drop_stale(Path(__file__).parents[1])
