"""Shortcuts through Warp's translation of Python to C++ and CUDA, which runs in one thread at a time.

What is written stays the same to the byte (``tests/test_translation.py``), but for what ``drop_unused_adjoints``
says. All are for commands alone, whose process changes no function and no constant once a module is imported. Where
this Warp translates in another way, nothing changes.
"""

from __future__ import annotations

import functools
import sys
from typing import Any, Final

import warp as wp

_AFTERWARDS: Final = ("cpu_compiler_flags",)
"""Options of modules that say nothing about what is written."""


def take_shortcuts() -> None:
    """Take all of them from now on; calling it again does nothing."""
    remember_references()
    remember_overloads()
    remember_functions()
    drop_unused_adjoints()


def remember_references() -> None:
    """Have Warp look for what a function of this package refers to once, not again for each kernel that calls it.

    That is half of what it takes to find a kernel in the cache.
    """
    adjoint = getattr(_part("codegen"), "Adjoint", None)
    find = getattr(adjoint, "get_references", None)
    if adjoint is None or find is None or hasattr(find, "__wrapped__"):
        return

    @functools.wraps(find)
    def get_references(adj: Any) -> Any:
        kept = adj.__dict__.get("_warp_ar_references")
        if kept is not None:
            return kept
        found = find(adj)
        home = sys.modules.get(adj.func.__module__)
        # While a module is imported, a function may name one that comes below it.
        if home is not None and _is_own(home) and not getattr(home.__spec__, "_initializing", False):
            adj._warp_ar_references = found
        return found

    adjoint.get_references = get_references


def remember_overloads() -> None:
    """Have Warp look once for the overload of a built-in function that takes arguments of some types.

    It tries them one after another, by Python's own binding of arguments, for each product and each sum.
    """
    adjoint = getattr(_part("codegen"), "Adjoint", None)
    find = getattr(adjoint, "resolve_func", None)
    if adjoint is None or find is None or hasattr(find, "__wrapped__"):
        return
    known: dict[Any, tuple[Any, Any]] = {}

    @functools.wraps(find)
    def resolve_func(adj: Any, func: Any, arg_types: Any, kwarg_types: Any, min_outputs: Any) -> Any:
        types = (*arg_types, *kwarg_types.values())
        # Arrays and functions among the arguments are values of their own.
        if not func.is_builtin() or not all(isinstance(kind, type) for kind in types):
            return find(adj, func, arg_types, kwarg_types, min_outputs)
        key = func.key, len(arg_types), types, tuple(kwarg_types), min_outputs
        entry = known.get(key)
        if entry is None or entry[0] is not func:
            entry = known[key] = func, find(adj, func, arg_types, kwarg_types, min_outputs)
        return entry[1]

    adjoint.resolve_func = resolve_func


def remember_functions() -> None:
    """Have Warp translate a function once for all modules that call it and have the same options.

    What a translation tells the module, which structs it uses and which other functions, is told to the next one in
    the same order.
    """
    builder: Any = getattr(_part("context"), "ModuleBuilder", None)
    build_plain: Any = getattr(builder, "build_function", None)
    struct_plain: Any = getattr(builder, "build_struct_recursive", None)
    if build_plain is None or struct_plain is None or hasattr(build_plain, "__wrapped__"):
        return
    said: list[list[Any]] = []

    @functools.wraps(struct_plain)
    def build_struct_recursive(self: Any, struct: Any) -> None:
        if said:
            said[-1].append(struct)
        struct_plain(self, struct)

    @functools.wraps(build_plain)
    def build_function(self: Any, func: Any) -> None:
        if said:
            said[-1].append(func)
        if dict.__contains__(self.functions, func):
            return
        if not isinstance(self.functions, _Reported):
            self.functions = _Reported(self.functions)
        adj = func.adj
        options = {name: value for name, value in self.options.items() if name not in _AFTERWARDS}
        key = self.target, options, adj.used_by_backward_kernel, adj.force_adjoint_codegen
        kept = adj.__dict__.get("_warp_ar_built")
        # Whoever else translates it gives it other blocks.
        if kept is None or kept[0] != key or kept[1] is not adj.blocks:
            said.append([])
            before = _linked(self)
            try:
                build_plain(self, func)
            finally:
                events = said.pop()
            if _linked(self) == before:
                adj._warp_ar_built = key, adj.blocks, events
            return
        said.append([])
        try:
            for item in kept[2]:
                if isinstance(item, wp.Function):
                    build_function(self, item)
                else:
                    struct_plain(self, item)
        finally:
            said.pop()
        for var in (*adj.args, *adj.variables):
            self._collect_native_types(var.type)
        self.functions[func] = None

    builder.build_function, builder.build_struct_recursive = build_function, build_struct_recursive


def drop_unused_adjoints() -> None:
    """Have Warp write the sums and adjoints of structs so that Clang leaves out those that a module does not call.

    As Warp writes them, other modules could call them, though none does: for each struct of each module Clang makes an
    atomic sum of all its fields, though no kernel here has an adjoint. It changes Warp's own text, not what modules are
    named by.
    """
    codegen = _part("codegen")
    template = getattr(codegen, "struct_template", None)
    if isinstance(template, str):
        for function in ("{name} add(", "void adj_atomic_add("):
            template = template.replace(f"\nCUDA_CALLABLE {function}", f"\ninline CUDA_CALLABLE {function}")
        codegen.struct_template = template


class _Reported(dict[Any, None]):
    """Functions of a module, of which it is told again whenever one is called: it seems to have none."""

    def __contains__(self, func: object) -> bool:
        return False


def _linked(builder: Any) -> tuple[int, ...]:
    """How much there is of what a translation adds to a module beside structs and functions."""
    return tuple(
        len(getattr(builder, name))
        for name in ("deferred_functions", "fatbins", "ltoirs", "ltoirs_decl", "shared_memory_bytes")
    )


def _part(name: str) -> Any:
    return getattr(getattr(wp, "_src", None), name, None)


def _is_own(module: Any) -> bool:
    return str(module.__name__).startswith("warp_ar.")
