"""Options, each stated once: fields of a frozen dataclass whose annotations carry their descriptions.

    @dataclass(frozen=True, kw_only=True)
    class TableOptions:
        digits: Annotated[int, Option("Significant digits.", metavar="N")] = 4

Command lines, the keywords of functions and the sentences about wrong ones follow from such a model.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from inspect import Parameter, signature
from typing import Annotated, Any, NamedTuple, TypeVar, get_origin, get_type_hints

from blocksar.errors import UnknownOption, quoted

Model = TypeVar("Model")
Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True)
class Option:
    """Description of a field, as the last part of its annotation.

    Attributes
    ----------
    help : str
        A sentence or two, for the command line.
    metavar : str or None
        What stands for its value there.
    default : str or None
        What stands for a default of None there.
    read : callable or None
        Turns a text of the command line, or a value of Python, into that of the field; raises InputError. Without it
        the command line has the field's own type.
    flags : tuple of str
        Its spellings there. Default: its name.
    least : int or None
        The least that the command line takes.
    choices : callable or None
        Gives the texts that the command line takes, when it is asked for them.
    """

    help: str
    metavar: str | None = None
    default: str | None = None
    read: Callable[[Any], Any] | None = None
    flags: tuple[str, ...] = ()
    least: int | None = None
    choices: Callable[[], Sequence[str]] | None = None


class Stated(NamedTuple):
    """An option of a model: its name, annotated type, default and description."""

    name: str
    type: Any
    default: Any
    option: Option


def options_of(model: type, *names: str) -> tuple[Stated, ...]:
    """The options of a model, or some, in the order of its fields; a field without an `Option` is none.

    Examples
    --------
    >>> from dataclasses import make_dataclass
    >>> from typing import Annotated
    >>> TableOptions = make_dataclass("TableOptions", [("digits", Annotated[int, Option("Significant digits.")], 4)])
    >>> [(each.name, each.type, each.default) for each in options_of(TableOptions)]
    [('digits', <class 'int'>, 4)]
    """
    return tuple(each for each in _all_options(model) if not names or each.name in names)


@cache
def _all_options(model: type) -> tuple[Stated, ...]:
    hints = get_type_hints(model, include_extras=True)
    annotated = [(field, hints[field.name]) for field in fields(model) if get_origin(hints[field.name]) is Annotated]
    return tuple(Stated(field.name, kind.__origin__, field.default, kind.__metadata__[-1]) for field, kind in annotated)


def read_options(model: type[Model], given: Mapping[str, Any], of: str, elsewhere: Iterable[tuple[str, type]]) -> Model:
    """Make a model from values by name; None stands for a default.

    Parameters
    ----------
    model : type
    given : mapping
    of : str
        What has the options, for messages.
    elsewhere : iterable of (str, type)
        Others of its kind with their models: an option that is one of theirs is said to be. Asked only then.

    Raises
    ------
    InputError
        If an option is not one of the model's, or a value is wrong.
    """
    known = {each.name: each for each in options_of(model)}
    asked = {name: value for name, value in given.items() if value is not None}
    for name, value in asked.items():
        if name not in known:
            raise UnknownOption(_not_one(name, value, of, known, elsewhere), name)
    return model(**read_values(known.values(), asked))


def nearest_argument(function: Callable[..., Any], name: str) -> str | None:
    """Return the argument or signature option of a function most similar to a misspelt name; None if there is none.

    Examples
    --------
    >>> nearest_argument(showing_options, "model")
    "showing_options has no argument 'model'; did you mean models?"
    """
    known = signature(function).parameters
    close = [] if name in known else difflib.get_close_matches(name, known, n=1)
    label = getattr(function, "__name__", "the function")
    return f"{label} has no argument {name!r}; did you mean {close[0]}?" if close else None


def check_arguments(function: Callable[..., Any], given: Iterable[str]) -> None:
    """Check the names of arguments for a function that takes only the arguments it states.

    Raises
    ------
    UnknownOption
        If it has none of a name; it says which is near.
    """
    known = signature(function).parameters
    if any(each.kind is Parameter.VAR_KEYWORD for each in known.values()):
        return  # reported when the options are read
    for name in given:
        if name not in known:
            message = nearest_argument(function, name)
            label = getattr(function, "__name__", "the function")
            raise UnknownOption(message or f"{label} has no argument {name!r}; it has {', '.join(known)}", name)


def read_values(options: Iterable[Stated], given: Mapping[str, Any]) -> dict[str, Any]:
    """Read values by name with the checks of their options; None as default stays None.

    Raises
    ------
    InputError
        If a value is wrong.
    """
    known = {each.name: each for each in options}

    def read(name: str, value: Any) -> Any:
        stated = known.get(name)
        if stated is None or stated.option.read is None or value is stated.default is None:
            return value
        return stated.option.read(value)

    return {name: read(name, value) for name, value in given.items()}


def showing_options(*models: type) -> Callable[[Function], Function]:
    """Decorate a function with **options: its displayed signature gets the options of models as well."""

    def decorate(function: Function) -> Function:
        plain = signature(function)
        *own, rest = plain.parameters.values()
        stated = {each.name: each for model in models for each in options_of(model)}
        options = [
            Parameter(each.name, Parameter.KEYWORD_ONLY, default=each.default, annotation=each.type)
            for each in stated.values()
        ]
        function.__signature__ = plain.replace(parameters=[*own, *options, rest])  # type: ignore[attr-defined]
        return function

    return decorate


def _not_one(name: str, value: Any, of: str, known: Mapping[str, Stated], elsewhere: Iterable[tuple[str, type]]) -> str:
    """Explain why an option cannot be given."""
    others = [other for other, model in elsewhere if name in (each.name for each in options_of(model))]
    if others:
        *first, last = others
        named = f"{', '.join(first)} and {last}" if first else last
        return f"{name} is {value!r}, but it is an option of {named} only; leave it out"
    close = difflib.get_close_matches(name, known, n=1)
    remedy = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}" if known else "leave it out"
    return f"{name} is {quoted(value)}, but {of} has no such option; {remedy}"
