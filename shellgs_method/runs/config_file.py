"""Read config.yml as data. Nerfstudio loads it as YAML that may build any Python object, that is, run any program."""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from numbers import Real
from pathlib import Path
from types import FunctionType, GenericAlias
from typing import Any, get_args, get_origin

import yaml
from nerfstudio.engine.trainer import TrainerConfig

from shellgs_method.errors import SceneError

MAX_BYTES = 1 << 20
"""Largest config.yml; those of nerfstudio's methods have a hundredth of it."""
_COMPLETE = ("method_name", "experiment_name", "timestamp", "output_dir", "pipeline", "vis")
"""Settings that every config.yml has; the last one is at its end."""


def load_config(path: Path) -> TrainerConfig:
    """Load the config of a run, building only classes of registered methods.

    Settings that an older file lacks have their defaults; those that no longer exist are left out.

    Args:
        path: a config.yml.

    Raises:
        FileNotFoundError: there is no such file.
        SceneError: it is not a complete config of a registered method.
    """
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise FileNotFoundError(f"{path} {what}: name the config.yml of a trained run")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SceneError(f"it has more than {MAX_BYTES} bytes")
        text = path.read_text("utf8")
        config = yaml.load(text, Loader=_Loader)
        if not isinstance(config, TrainerConfig):
            raise SceneError("it holds no config of a run" if text.strip() else "it is empty")
        lacking = [name for name in _COMPLETE if f"\n{name}:" not in text]
        if lacking:
            raise SceneError(f"it is cut off: {lacking[0]} is missing")
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)  # YAML's own text quotes the file
        what = f"line {mark.line + 1}: {error.problem}" if mark else " ".join(str(error).split())  # pyright: ignore
        raise SceneError(
            f"{path} cannot be read as the config.yml of a run ({what}): name one that ns-train wrote, or train again"
        ) from error
    return config


@cache
def _known() -> dict[str, Any]:
    """Classes, functions and types of values in the configs of registered methods, by import path."""
    from nerfstudio.configs.dataparser_configs import all_dataparsers  # both import the methods, and so this module
    from nerfstudio.configs.method_configs import all_methods

    found: dict[str, Any] = {}
    configs = [config for config in all_methods.values() if isinstance(config, TrainerConfig)]
    for part in _parts([*configs, *all_dataparsers.values()]):
        found[f"{part.__module__}.{part.__qualname__}"] = part
    return found


def _parts(value: Any) -> Iterator[Any]:
    """Classes and functions in a config, and the classes of its values."""
    if isinstance(value, (type, FunctionType)) and not isinstance(value, GenericAlias):
        yield value
    elif get_origin(value):
        yield from _parts([get_origin(value), *get_args(value)])
    elif isinstance(value, dict):
        yield from _parts(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _parts(each)
    elif isinstance(value, Enum):
        yield type(value)
    elif is_dataclass(value):
        yield type(value)
        yield from _parts([getattr(value, field.name) for field in fields(value)])


def _find(path: str) -> Any:
    """The known object of an import path, or of an alias of it in an imported module; nothing is imported."""
    module, _, name = path.rpartition(".")
    elsewhere = vars(sys.modules[module]).get(name) if module in sys.modules else None
    found = _known().get(path, elsewhere)
    if not any(found is each for each in _known().values()):
        raise SceneError(f"it names {path}, which is in no registered method's config; that may be a program to run")
    return found


def _object(loader: Any, path: str, node: yaml.Node) -> Any:
    cls = _find(path)
    if not (isinstance(cls, type) and is_dataclass(cls)):
        raise SceneError(f"it uses {path} as settings")
    values = loader.construct_mapping(node, deep=True)
    given = [field for field in fields(cls) if field.init and field.name in values]
    for field in given:
        if not _fits(values[field.name], field):
            raise SceneError(f"{field.name} of {cls.__name__} cannot be {values[field.name]!r}")
    return cls(**{field.name: values[field.name] for field in given})


def _fits(value: Any, field: Field) -> bool:
    """Whether a value has its setting's type, as far as the default shows."""
    default = field.default if field.default_factory is MISSING else field.default_factory()
    if value is None or default is None:
        return default is None or not isinstance(default, Real)
    if is_dataclass(default):
        return is_dataclass(value)
    for kind in (bool, Real, str, Path, dict):
        if isinstance(default, kind):
            return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    return True


def _call(loader: Any, path: str, node: yaml.Node) -> Any:
    """Build what PyYAML writes as a call: paths, enumerations, and generic classes with their parameters."""
    arguments = loader.construct_sequence(node, deep=True)
    if path in ("pathlib.PosixPath", "pathlib.WindowsPath", "pathlib._local.PosixPath", "pathlib._local.WindowsPath"):
        return pathlib.Path(*arguments)
    if path == "_operator.getitem":
        generic, parameters = arguments
        if isinstance(generic, type):
            return generic[parameters]  # pyright: ignore[reportIndexIssue]
    if path == "builtins.getattr":  # an enumeration's value, as the first versions of Python 3.11 write it
        kind, name = arguments
        if isinstance(kind, type) and issubclass(kind, Enum) and name in kind.__members__:
            return kind[name]
    kind = _find(path)
    if not (isinstance(kind, type) and issubclass(kind, Enum)):
        raise SceneError(f"it calls {path}")
    return kind(*arguments)


def _tuple(loader: Any, node: Any) -> tuple:
    return tuple(loader.construct_sequence(node, deep=True))


def _refused(_loader: Any, path: str, _node: yaml.Node) -> Any:
    raise SceneError(f"it imports {path}")


_CONSTRUCTORS: dict[str, Callable[[Any, str, yaml.Node], Any]] = {
    "name:": lambda _loader, path, _node: _find(path),
    "object:": _object,
    "object/apply:": _call,
    "object/new:": _refused,
    "module:": _refused,
}


class _Loader(yaml.SafeLoader):
    """Plain YAML and the tags of configs."""


_Loader.add_constructor("tag:yaml.org,2002:python/tuple", _tuple)
for _tag, _construct in _CONSTRUCTORS.items():
    _Loader.add_multi_constructor(f"tag:yaml.org,2002:python/{_tag}", _construct)
