"""The base class of extractors, aggregators and matchers; the same contract as hloc's."""

import importlib
import inspect
import pkgutil
from numbers import Number
from types import ModuleType
from typing import TypeVar

from torch import nn

from .cli import InputError, choose

Model = TypeVar("Model", bound="BaseModel")


class BaseModel(nn.Module):
    """A model with a `default_conf` whose subclasses write `_init` and `_forward`.

    Args:
        conf: overrides of `default_conf`, and optionally the key `name`.

    Raises:
        InputError: for an unknown configuration key, or a value of another type than its default.
    """

    default_conf: dict = {}
    required_inputs: tuple[str, ...] = ()

    def __init__(self, conf: dict):
        super().__init__()
        unknown = set(conf) - set(self.default_conf) - {"name"}
        if unknown:
            raise InputError(
                f"{type(self).__name__} has no option {', '.join(sorted(unknown))}. "
                f"It has: {', '.join(self.default_conf)}."
            )
        for kind in (Number, str, dict):
            for key, value in conf.items():
                default = self.default_conf.get(key)
                if isinstance(default, kind) and not isinstance(value, kind):
                    raise InputError(f"{type(self).__name__}: {key} cannot be {value!r}.")
        self.conf = {**self.default_conf, **conf}
        self._init(self.conf)

    def forward(self, data: dict) -> dict:
        """Check that no required input is missing and compute the predictions."""
        missing = [key for key in self.required_inputs if key not in data]
        if missing:
            raise InputError(f"{type(self).__name__} needs {', '.join(missing)}.")
        return self._forward(data)

    def _init(self, conf: dict) -> None:
        pass

    def _forward(self, data: dict) -> dict:
        raise NotImplementedError


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
