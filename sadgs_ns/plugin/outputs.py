"""The outputs of a rendering, of which some are computed only for those who read them."""

from __future__ import annotations

from collections import UserDict
from typing import Any

from torch import Tensor


class LazyOutputs(UserDict[str, Any]):
    """Tensors by name, as nerfstudio reads them: a function that stands in for a tensor is called at the first read.

    nerfstudio does not tell a model which of its outputs are wanted, so that each of them would cost `ns-eval` and
    `ns-render` time, also where nobody looks at it.
    """

    def __getitem__(self, name: str) -> Tensor:
        value: Any = self.data[name]
        if callable(value):
            value = self.data[name] = value()
        return value
