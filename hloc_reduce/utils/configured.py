"""Models with a configuration, and the packages that they are found in by name."""

import importlib
import inspect
import pkgutil
from numbers import Number
from types import ModuleType
from typing import TypeVar

from .cli import InputError, choose

Model = TypeVar("Model")


def configure(name: str, default: dict, conf: dict) -> dict:
    """Return the configuration of a model: its default with overrides.

    Args:
        name: of the model, for messages.
        default: the default configuration.
        conf: overrides, and optionally the key `name`.

    Raises:
        InputError: for an unknown key, or a value of another type than its default.
    """
    if unknown := set(conf) - set(default) - {"name"}:
        raise InputError(
            f"{name} has no option {', '.join(sorted(unknown))}. It has: {', '.join(default)}."
        )
    for kind in (Number, str, dict):
        for key, value in conf.items():
            if isinstance(default.get(key), kind) and not isinstance(value, kind):
                raise InputError(f"{name}: {key} cannot be {value!r}.")
    return {**default, **conf}


def dynamic_load(root: ModuleType, name: str, base: type[Model]) -> type[Model]:
    """Return the one subclass of `base` that the module `name` of the package `root` defines.

    Modules whose names are in `root.HELPERS` define none.

    Raises:
        InputError: when there is no such module.
    """
    helpers = getattr(root, "HELPERS", ())
    found = [module.name for module in pkgutil.iter_modules(root.__path__)]
    names = [name for name in found if name not in helpers]
    kind = root.__name__.rpartition(".")[2].removesuffix("s")
    module = importlib.import_module(f"{root.__name__}.{choose(kind, name, names)}")
    (model,) = (
        value
        for _, value in inspect.getmembers(module, inspect.isclass)
        if value.__module__ == module.__name__ and issubclass(value, base)
    )
    return model
