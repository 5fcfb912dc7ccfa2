"""The base class of extractors and matchers; the same contract as hloc's."""

from torch import nn

from .cli import InputError
from .configured import configure


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
        self.conf = configure(type(self).__name__, self.default_conf, conf)
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
