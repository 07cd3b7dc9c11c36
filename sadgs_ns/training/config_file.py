"""Reads a run's `config.yml` without executing what it names.

nerfstudio writes and reads options by PyYAML's full loader, which imports any module and calls any function that the
file names. Here a file may name dataclasses, classes and enumerations of nerfstudio and of this package, optimizers of
torch, and paths.
"""

from __future__ import annotations

import dataclasses
import enum
import inspect
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import ConstructorError

_PACKAGES = ("nerfstudio", "sadgs_ns", "torch.optim")
_PREFIX = "tag:yaml.org,2002:python/"


class ConfigLoader(yaml.SafeLoader):
    """Makes options and what they hold; raises yaml.YAMLError if the file asks for anything else."""


def _class_named(name: str, node: yaml.Node) -> type:
    """Return the class of a dotted name, if a file may name it; raise ConstructorError otherwise."""
    module, _, attribute = name.rpartition(".")
    found = None
    if _is_allowed(module):
        try:
            found = getattr(import_module(module), attribute, None)
        except ImportError as error:
            raise ConstructorError(None, None, f"it names {name}, which cannot be imported", node.start_mark) from error
    if not inspect.isclass(found) or not _is_allowed(found.__module__):
        problem = f"it names {name}, which is no class of nerfstudio or sadgs"
        raise ConstructorError(None, None, problem, node.start_mark)
    return found


def _is_allowed(module: str) -> bool:
    """Tell whether a module is one of those whose classes a file may name."""
    return any(f"{module}.".startswith(f"{package}.") for package in _PACKAGES)


def _make_options(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    """Make an object of a dataclass with the values of a mapping."""
    cls = _class_named(name, node)
    if not dataclasses.is_dataclass(cls) or not isinstance(node, yaml.MappingNode):
        raise ConstructorError(None, None, f"it makes a {name}, which holds no options", node.start_mark)
    values: dict[Any, Any] = loader.construct_mapping(node, deep=True)
    options: Any = cls.__new__(cls)
    if hasattr(options, "__setstate__"):  # Those of ours fill in what an earlier version did not have.
        options.__setstate__(values)
    else:
        vars(options).update(values)
    return options


def _make_value(loader: ConfigLoader, name: str, node: yaml.Node) -> Any:
    """Make a path, or a member of an enumeration, from a list of arguments."""
    arguments = []
    if isinstance(node, yaml.SequenceNode):
        arguments = loader.construct_sequence(node, deep=True)
    if name in ("pathlib.Path", "pathlib.PosixPath", "pathlib._local.PosixPath"):
        return Path(*arguments)
    cls = _class_named(name, node)
    if not issubclass(cls, enum.Enum):
        raise ConstructorError(None, None, f"it calls {name}", node.start_mark)
    return cls(*arguments)


def _name_class(loader: ConfigLoader, name: str, node: yaml.Node) -> type:
    """Return the class that a value names."""
    return _class_named(name, node)


def _make_tuple(loader: ConfigLoader, node: Any) -> tuple[Any, ...]:
    """Make a tuple of a list."""
    return tuple(loader.construct_sequence(node, deep=True))


ConfigLoader.add_multi_constructor(f"{_PREFIX}object:", _make_options)
ConfigLoader.add_multi_constructor(f"{_PREFIX}object/apply:", _make_value)
ConfigLoader.add_multi_constructor(f"{_PREFIX}name:", _name_class)
ConfigLoader.add_constructor(f"{_PREFIX}tuple", _make_tuple)
