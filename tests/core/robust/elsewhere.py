"""A device without a GPU: torch's "meta" device, and a watch on what crosses its border.

Tensors on "meta" have a shape and a device, but no numbers. To read one, or to copy it to the CPU, raises; what a GPU
would wait for is found without one. Both are torch's public interface, which the modes that pretend to be CUDA are not.
torch itself does not tell of copies to the device, nor of all operations on tensors of two devices: the watch does.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode, resolve_name

ELSEWHERE = torch.device("meta")
_MAKERS = (torch.tensor, torch.as_tensor, Tensor.new_tensor)


class Border(TorchFunctionMode):
    """Raises where an operation mixes devices; ``copies`` names what brought numbers from the CPU to the device."""

    def __init__(self) -> None:
        super().__init__()
        self.copies: list[str] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        given = [one for one in _tensors([args, kwargs or {}]) if one.ndim > 0]
        devices = {one.device for one in given}
        made = {one.device for one in _tensors(result)}
        name = resolve_name(func)
        if len(devices) > 1 and name != "torch.Tensor.to":
            raise AssertionError(f"{name} mixes {devices}")
        if ELSEWHERE in made and ELSEWHERE not in devices and (given or func in _MAKERS):
            self.copies.append(str(name))
        return result


def _tensors(values: Any) -> Iterator[Tensor]:
    if isinstance(values, Tensor):
        yield values
    elif isinstance(values, dict):
        yield from _tensors(list(values.values()))
    elif isinstance(values, list | tuple):
        for one in values:
            yield from _tensors(one)
