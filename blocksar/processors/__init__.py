"""Processors: ways to form an image. Others add theirs under the entry-point group `blocksar.processors`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from blocksar.errors import InputError
from blocksar.options import options_of, read_options
from blocksar.plugins import Registry

if TYPE_CHECKING:
    from blocksar.processors.base import Processor


def _check(processor: Processor) -> None:
    """Check that a processor has all attributes that planning needs."""
    options_of(processor.options)
    if not all((processor.summary, callable(processor.plan), callable(processor.check))):
        raise TypeError("a processor has a summary, options, and functions to check these and to plan")
    _ = processor.universal, processor.compared, processor.on_gpu


# Names for editors; the registry may have more.
OwnProcessor = Literal[
    "angular-division", "keystone-resampling", "high-order-phase", "hierarchical-backprojection", "backprojection",
    "auto",
]  # fmt: skip
OwnDevice = Literal["cpu", "gpu", "auto"]
CHAINS = "blocksar.processors.chain.processor"
PROCESSORS: Registry[Processor] = Registry(
    "blocksar.processors",
    "processor",
    {
        "angular-division": f"{CHAINS}:ANGULAR_DIVISION",
        "keystone-resampling": f"{CHAINS}:KEYSTONE_RESAMPLING",
        "high-order-phase": f"{CHAINS}:HIGH_ORDER_PHASE",
        "hierarchical-backprojection": "blocksar.processors.hierarchy.processor:HIERARCHICAL",
        "backprojection": "blocksar.processors.exact.processor:EXACT",
        "auto": "blocksar.processors.auto:CHOICE",
    },
    _check,
)
REFERENCE = "backprojection"  # takes any collection; all others are judged by it
HIERARCHY = "hierarchical-backprojection"  # takes any collection, and is faster
AUTO = "auto"  # chooses among the others
CHAIN = "angular-division"  # of the chains, which are alike, the one that it considers


def device_for(name: str, asked: str) -> str:
    """Return the device that a processor runs on, "cpu" or "gpu"; `asked` may be "auto": a GPU if one is found.

    Raises
    ------
    InputError
        If it does not run on a GPU, which is asked for.
    """
    able = PROCESSORS.get(name).on_gpu
    if asked == "gpu" and not able:
        others = " or ".join(each for each, part in PROCESSORS.sound() if part.on_gpu)
        raise InputError(f"processor {name} does not run on a GPU; give --processor {others}, or leave --device out")
    if asked != "auto" or not able:
        return "cpu" if asked == "auto" else asked
    from blocksar.kernels.device import has_gpu  # with the loops, which take long to load

    return "gpu" if has_gpu() else "cpu"


def options_for(name: str, given: Mapping[str, Any]) -> Any:
    """Make the options of a processor from values by name; None stands for a default.

    Raises
    ------
    InputError
        If there is no such processor, or an option is wrong or not one of its own.
    """
    processor = PROCESSORS.get(name)
    given = {key: value for key, value in given.items() if value is not None}
    own = {each.name for each in options_of(processor.options)}
    if not own.issuperset(given):  # another processor's default values are ignored
        stated = {each.name: each.default for _, other in PROCESSORS.sound() for each in options_of(other.options)}
        given = {key: value for key, value in given.items() if key in own or value != stated.get(key)}
    # The reference and the automatic choice have the options of chains only to record them in settings.
    sound = ((other, part) for other, part in PROCESSORS.sound() if other not in (REFERENCE, AUTO))
    others = ((other, part.options) for other, part in sound if part.options is not processor.options)
    options: Any = read_options(processor.options, given, f"processor {name}", others)
    processor.check(options)
    return options
