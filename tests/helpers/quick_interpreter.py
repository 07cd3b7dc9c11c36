"""Triton's interpreter without work that it repeats in vain, which is half of its time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from triton import language as tl
from triton.language import core
from triton.language.semantic import TritonSemantic
from triton.runtime import interpreter


def speed_up() -> None:
    """Change the interpreter of this process. What kernels compute stays the same.

    Raises:
        AttributeError: If this version of Triton has not what is changed.
        TypeError: If it has it in another form.
    """
    leave_out_overflow()
    patch_language_once()
    look_up_dtypes()
    keep_types_of_shapes()
    keep_shapes_of_tensors()
    broadcast_only_if_shapes_differ()


def leave_out_overflow() -> None:
    """Leave out whether each sum and product of integers overflows, which is asserted if debugging alone."""
    builder = interpreter.interpreter_builder
    if not builder.options.debug:
        builder.options = dataclasses.replace(builder.options, sanitize_overflow=False)


def patch_language_once() -> None:
    """Put the interpreter's functions into `triton.language` once a launch, not at each call within a kernel, too."""
    patch = interpreter._patch_lang
    scopes: Any = interpreter._LangPatchScope
    restore = scopes.restore
    patched: set[int] = set()
    """The ids of the modules that the launch has patched."""

    def patch_once(function: Callable[..., Any]) -> Any:
        modules = [value for value in function.__globals__.values() if value is tl or value is core]
        missing = {id(module) for module in modules} - patched
        if modules and not missing:
            return scopes()
        patched.update(missing)
        return patch(function)

    def restore_and_forget(scope: Any) -> None:
        patched.clear()
        restore(scope)

    interpreter._patch_lang = patch_once
    scopes.restore = restore_and_forget


def look_up_dtypes() -> None:
    """Find NumPy's dtypes in one table, which the interpreter makes anew whenever it asks."""
    find = interpreter._get_np_dtype
    found: dict[str, Any] = {}

    def find_once(dtype: Any) -> Any:
        if isinstance(dtype, tl.block_type):
            dtype = dtype.element_ty
        if dtype.name not in found:
            found[dtype.name] = find(dtype)
        return found[dtype.name]

    interpreter._get_np_dtype = find_once


def keep_types_of_shapes() -> None:
    """Keep the types of tuples of constants, such as shapes; the interpreter writes the name of each anew."""
    type_of = core._type_for_tuple_values
    kept: dict[tuple[int, ...], Any] = {}

    def type_once(values: list[Any], fields: Any = None) -> Any:
        numbers = tuple([value.value if type(value) is core.constexpr else value for value in values])
        if fields is not None or not all([type(number) is int for number in numbers]):
            return type_of(values, fields)
        if numbers not in kept:
            kept[numbers] = type_of(values)
        return kept[numbers]

    core._type_for_tuple_values = type_once


def keep_shapes_of_tensors() -> None:
    """Keep the shapes of tensors, as tuples of constants, and the products of their sizes."""
    tensors: Any = core.tensor
    initialize = tensors.__init__
    kept: dict[tuple[int, ...], Any] = {}

    def initialize_with_kept(tensor: Any, handle: Any, dtype: Any) -> None:
        sizes = ()
        if dtype.is_block():
            sizes = tuple(dtype.shape.values)
        if sizes not in kept:
            initialize(tensor, handle, dtype)
            kept[sizes] = (tensor.shape, tensor.numel)
        tensor.handle = handle
        tensor.type = dtype
        tensor.dtype = dtype.scalar
        tensor.shape, tensor.numel = kept[sizes]

    tensors.__init__ = initialize_with_kept


def broadcast_only_if_shapes_differ() -> None:
    """Return operands of one shape as they are; the interpreter finds out size by size that nothing is to be done."""
    semantics: Any = TritonSemantic
    broadcast = semantics.broadcast_impl_value

    def broadcast_others(semantic: Any, left: Any, right: Any) -> Any:
        if left.type.is_block() and right.type.is_block() and left.type.shape.values == right.type.shape.values:
            return left, right
        return broadcast(semantic, left, right)

    semantics.broadcast_impl_value = broadcast_others
