"""The device and the precision that a command computes in, by their names."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from attnwarp.errors import InputError, MissingExtraError, install_command
from attnwarp.reporting import SILENT, Reporter

if TYPE_CHECKING:
    import torch

P = ParamSpec("P")
T = TypeVar("T")

TYPES = ("auto", "float32", "float16", "bfloat16")


def device_of(name: str) -> torch.device:
    """A device by its name, "cpu", "cuda" or "cuda:1".

    Raises:
        InputError: there is none of that name.

    Example:
        >>> device_of("cpu")
        device(type='cpu')
    """
    import torch

    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError(f"device {name!r}: unknown, expected cpu or cuda") from None
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"device {name!r}: not supported, expected cpu or cuda")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device {name!r}: this machine or this torch has no CUDA; name cpu")
    return device


def choose(name: str, report: Reporter = SILENT, *, splats: bool = True) -> str:
    """The device of a command's ``--device``: "auto" is the GPU where there is one.

    Args:
        name: "auto", or as of :func:`device_of`.
        report: receives a line where "auto" finds a GPU.
        splats: they are rendered there too, which takes the extra ``gpu``.

    Raises:
        InputError: no such device.
        MissingExtraError: a GPU is named, and the extra is missing.

    Example:
        >>> choose("cpu")
        'cpu'
    """
    import torch

    has_kernels = not splats or importlib.util.find_spec("warp") is not None
    if name != "auto":
        if device_of(name).type == "cuda" and not has_kernels:
            raise MissingExtraError("warp", "gpu")
        return name
    if not torch.cuda.is_available():
        return "cpu"
    found = torch.cuda.get_device_name()
    if not has_kernels:
        report.log(f"{found} is left alone: splats on it need Warp; {install_command('gpu')}")
        return "cpu"
    report.log(f"on {found}; --device cpu computes on the processor")
    return "cuda"


def type_of(name: str, device: str) -> torch.dtype:
    """The precision of an editor's networks.

    Args:
        name: "float32", "float16", "bfloat16" or "auto": float16 on a GPU, float32 elsewhere. Edits
            by the bundled editors stay within 71 dB of float32 in float16, and 51 dB in bfloat16.
        device: as :func:`choose` gives it.

    Raises:
        InputError: no such precision.

    Example:
        >>> type_of("auto", "cpu"), type_of("auto", "cuda"), type_of("bfloat16", "cpu")
        (torch.float32, torch.float16, torch.bfloat16)
    """
    import torch

    if name not in TYPES:
        raise InputError(f"dtype {name!r}: unknown, expected one of {', '.join(TYPES)}")
    if name == "auto":
        return torch.float32 if device == "cpu" else torch.float16
    dtype: torch.dtype = getattr(torch, name)
    return dtype


def peak_memory(device: str) -> str:
    """The most memory of a GPU that torch held so far, for the end of a line; nothing for a CPU.

    Example:
        >>> peak_memory("cpu")
        ''
    """
    if device == "cpu":
        return ""
    import torch

    return f", at most {torch.cuda.max_memory_allocated(device) / 2**30:.1f} GiB of the GPU"


def on_cpu_unless_named(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function so that tensors whose device it does not name lie on the CPU, also in a
    process that makes them elsewhere (``torch.set_default_device``).

    Example:
        >>> import torch
        >>> @on_cpu_unless_named
        ... def zeros():
        ...     return torch.zeros(2)
        >>> with torch.device("meta"):
        ...     zeros().device
        device(type='cpu')
    """

    @wraps(function)
    def called(*arguments: P.args, **named: P.kwargs) -> T:
        import torch

        # Under a context every call of torch passes through Python, so it is entered where needed.
        if torch.get_default_device().type == "cpu":
            return function(*arguments, **named)
        with torch.device("cpu"):
            return function(*arguments, **named)

    return called
