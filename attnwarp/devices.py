"""Device and precision of a command, by name."""

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
    """Find a device by name, "cpu", "cuda" or "cuda:1".

    Raises:
        InputError: no device has this name.

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
    """Resolve a command's ``--device``: "auto" is the GPU if there is one.

    Args:
        name: "auto", or a name of :func:`device_of`.
        splats: True if splats are rendered there too, which needs the extra ``gpu``.

    Raises:
        InputError: the device does not exist.
        MissingExtraError: a GPU is requested, but the extra is missing.

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


def type_of(name: str, device: str, half: torch.dtype | None = None) -> torch.dtype:
    """Resolve the precision of an editor's networks.

    Args:
        name: "float32", "float16", "bfloat16" or "auto": half on a GPU, float32 elsewhere. Edits by
            the bundled editors stay within 71 dB of float32 in float16, and 51 dB in bfloat16.
        device: device name, as returned by :func:`choose`.
        half: half precision of "auto"; float16 if omitted.

    Raises:
        InputError: the precision is unknown.

    Example:
        >>> type_of("auto", "cpu"), type_of("auto", "cuda"), type_of("bfloat16", "cpu")
        (torch.float32, torch.float16, torch.bfloat16)
    """
    import torch

    if name not in TYPES:
        raise InputError(f"dtype {name!r}: unknown, expected one of {', '.join(TYPES)}")
    if name == "auto":
        return torch.float32 if device == "cpu" else half or torch.float16
    dtype: torch.dtype = getattr(torch, name)
    return dtype


def peak_memory(device: str) -> str:
    """Describe torch's peak memory on a GPU, for the end of a line; empty for a CPU.

    Example:
        >>> peak_memory("cpu")
        ''
    """
    if device == "cpu":
        return ""
    import torch

    return f", at most {torch.cuda.max_memory_allocated(device) / 2**30:.1f} GiB of the GPU"


def with_gradients(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function so that it can differentiate what it computes, whether the caller has
    turned gradients off (``torch.no_grad``, ``torch.inference_mode``) or not.

    Example:
        >>> import torch
        >>> @with_gradients
        ... def slope():
        ...     x = torch.ones(2, requires_grad=True)
        ...     return torch.autograd.grad(x.square().sum(), x)[0].tolist()
        >>> with torch.inference_mode():
        ...     slope()
        [2.0, 2.0]
    """

    @wraps(function)
    def called(*arguments: P.args, **named: P.kwargs) -> T:
        import torch

        with torch.inference_mode(False), torch.enable_grad():
            return function(*arguments, **named)

    return called


def on_cpu_unless_named(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function so that tensors without a named device are created on the CPU, even if
    the process's default differs (``torch.set_default_device``).

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

        # The context slows every torch call, so it is entered only if needed.
        if torch.get_default_device().type == "cpu":
            return function(*arguments, **named)
        with torch.device("cpu"):
            return function(*arguments, **named)

    return called
