"""Methods of focusing: a processor and its options, named as in commands and settings."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, get_args, get_type_hints

from blocksar.errors import InputError
from blocksar.options import Option

Chain = Literal["angular-division", "keystone-resampling", "high-order-phase"]
Coefficients = Literal["fitted", "closed-form"]
Perturbation = Literal["all", "frequency", "none"]
Derotation = Literal["nonlinear", "linear"]
RangeModel = Literal["polar", "conventional"]
Cutting = Literal["notch", "eigen"]  # of interference, see `imaging.interference`


@dataclass(frozen=True, kw_only=True)
class ChainOptions:
    """Options of chains. One that is not the default makes a variant, for comparison only.

    Attributes
    ----------
    coefficients : {"fitted", "closed-form"}
        Fitted on time-frequency lines, or expanded about the block's centre as printed in the papers.
    perturbation : {"all", "frequency", "none"}
        "frequency": a perturbation in Doppler only, instead of perturbation in time and resampling (it stands in for
        the FDPF column of paper B's Table 2; the paper only names that method). "none": a deramp only (paper A, Figure
        9 a).
    keystone : bool
        False: RCMC in the time domain by one reference, no keystone (paper A, Figure 11 a-c).
    derotation : {"nonlinear", "linear"}
        "linear": the recovery removes one Doppler rate only (paper A, Figure 6 b), and needs a higher PRF.
    range_model : {"polar", "conventional"}
        "conventional": closed-form coefficients from a range model whose variables are substituted after range-walk
        correction; with one block, the reference method of paper A's Table 2 and Figure 14
        (`processors.chain.planning.coefficients`).
    """

    coefficients: Annotated[Coefficients, Option("Fitted to time-frequency lines, or by the paper's closed forms.")] = (
        "fitted"
    )
    perturbation: Annotated[
        Perturbation, Option("All of the processor's, the one in Doppler only, or none: deramp only.")
    ] = "all"
    keystone: Annotated[bool, Option("Without keystone: RCMC by one reference in time.")] = True
    derotation: Annotated[Derotation, Option("Linear: a single Doppler rate, which needs a higher PRF.")] = "nonlinear"
    range_model: Annotated[RangeModel, Option("Conventional: substitute variables after RWC; needs closed-form.")] = (
        "polar"
    )

    @property
    def departures(self) -> list[str]:
        """Names of the options that are not the default."""
        return [f.name for f in fields(ChainOptions) if getattr(self, f.name) != f.default]


@dataclass(frozen=True, kw_only=True)
class Method(ChainOptions):
    """A chain and its options.

    Attributes
    ----------
    processor : {"angular-division", "keystone-resampling", "high-order-phase"}

    Raises
    ------
    InputError
        If an option is unknown, or options contradict each other.
    """

    processor: Chain = "angular-division"

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for field in fields(self):
            value, known = getattr(self, field.name), get_args(hints[field.name]) or (True, False)
            if value not in known:
                raise InputError(f"{field.name} {value!r} is unknown; use {', '.join(map(str, known))}")
        if not self.keystone and self.processor == "high-order-phase":
            raise InputError(
                "keystone = False: high-order-phase has no keystone to leave out; ask for angular-division or "
                "keystone-resampling"
            )
        closed = self.coefficients == "closed-form" and self.processor == "angular-division"
        if self.range_model == "conventional" and not closed:
            raise InputError(
                "range_model conventional makes closed-form coefficients for angular-division; ask for coefficients "
                "closed-form and that processor with it"
            )

    @property
    def variant(self) -> bool:
        """Tell whether the method is for comparison only, so that residual errors are no reason to refuse a plan."""
        return bool(self.departures)

    def as_settings(self) -> dict[str, Any]:
        return {"processor": self.processor} | {f.name: getattr(self, f.name) for f in fields(ChainOptions)}


DEFAULT = Method()
