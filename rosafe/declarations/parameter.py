"""Parameters: type, default, range and choices of a value that a user can set, and how such values are read."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosafe.declarations.checks import (
    bad_count,
    bad_flag,
    bad_name,
    bad_optional_text,
    bad_type,
    duplicate,
    each,
    field_problems,
    is_number,
    tuple_problems,
)
from rosafe.declarations.idl import SCALARS, element
from rosafe.declarations.text import closest_match, did_you_mean, short_repr

REQUIRED = object()  # the default of a parameter without one, such as `local` of connect_port
MAX_STRING = 4096  # characters in any string of a request
MAX_SEQUENCE = 1024  # elements in any list of a request, and channels of a filterbank


def _to_python(value: Any) -> Any:
    """Convert a numpy number or an array without dimensions to a Python number; NaN if it is masked."""
    if not hasattr(value, "item") or getattr(value, "ndim", 1) != 0:
        return value
    return math.nan if getattr(value, "mask", False) else value.item()


@dataclass(frozen=True)
class Parameter:
    """One member of a request, or one parameter of a processor.

    `minimum` and `maximum` are inclusive, except for the minimum if `open_minimum` is set. They limit the elements of a
    sequence, `least` and `most` its length, `longest` the characters of a text. `choices` are the valid values of an
    enumerated string, or of each element of a list of strings. `real`, `positive`, `count`, `text` and `flag` create
    parameters of the usual types.
    Requests from the ROS graph may contain any word: `resolve_choice` replaces an unknown one by `fallback`, as the
    original does. Without a fallback, and in all other interfaces, an unknown word is an error.
    """

    name: str
    idl: str
    default: Any
    doc: str
    minimum: float | None = None
    maximum: float | None = None
    open_minimum: bool = False
    choices: tuple[str, ...] = ()
    fallback: str = ""
    aliases: tuple[str, ...] = ()  # further names, valid in all interfaces
    former: tuple[str, ...] = ()  # the original's misspelt names in modifyParameter, with values such as `_power`
    spellings: Mapping[str, str] = field(default_factory=dict, hash=False)  # corrections of values: jespen is jepsen
    unit: str = ""
    least: int = 0
    most: int = MAX_SEQUENCE
    longest: int = MAX_STRING
    ascending: bool = False  # each number of a sequence is above the previous one
    zero_is_default: bool = True  # in ROS requests, which carry no defaults
    follows_rate: bool = False  # if no value is given, the default may be replaced by one that suits the sample rate
    checked_by_client: bool = False  # for a number in the component, whose error could not name the choices

    @classmethod
    def real(
        cls, name: str, default: Any, doc: str, minimum: float | None = None, maximum: float | None = None, **more: Any
    ) -> Parameter:
        """Return a real number, with `more` attributes by name."""
        return cls(name, "double", default, doc, minimum, maximum, **more)

    @classmethod
    def positive(cls, name: str, default: Any, doc: str, maximum: float | None = None, **more: Any) -> Parameter:
        """Return a real number above 0."""
        return cls(name, "double", default, doc, 0.0, maximum, open_minimum=True, **more)

    @classmethod
    def count(
        cls, name: str, default: Any, doc: str, minimum: int | None = None, maximum: int | None = None, **more: Any
    ) -> Parameter:
        """Return a whole number that is not negative."""
        return cls(name, "unsigned long", default, doc, minimum, maximum, **more)

    @classmethod
    def text(cls, name: str, default: Any, doc: str, choices: tuple[str, ...] = (), **more: Any) -> Parameter:
        """Return a string, if `choices` are given one of them."""
        return cls(name, "string", default, doc, choices=choices, **more)

    @classmethod
    def flag(cls, name: str, default: Any, doc: str, **more: Any) -> Parameter:
        """Return a boolean."""
        return cls(name, "boolean", default, doc, **more)

    def __post_init__(self) -> None:
        for problem in itertools.chain(_declaration_problems(self), self._default_problems()):
            raise ValueError(f"parameter {short_repr(self.name)}: {problem}")

    def _default_problems(self) -> Iterator[str]:
        """Check the default; a list becomes a tuple, which is immutable and hashable."""
        if self.default is not REQUIRED:
            try:
                checked = self.check(self.default)
            except ValueError as problem:
                yield f"default: {problem}"
            if element(self.idl) and not isinstance(self.default, tuple):
                object.__setattr__(self, "default", tuple(checked))

    @property
    def range_text(self) -> str:
        """The range or the choices, for help texts and error messages; empty if there is no limit."""
        if self.choices:
            named = ", ".join(filter(None, self.choices))
            return f"one of {named}" + (", or empty" if "" in self.choices else "")
        low, high = (None if limit is None else _format_limit(limit) for limit in (self.minimum, self.maximum))
        if low is None:
            return "" if high is None else f"at most {high}"
        if high is None:
            return f"{'above' if self.open_minimum else 'at least'} {low}"
        return f"above {low}, at most {high}" if self.open_minimum else f"from {low} to {high}"

    # --- values -----------------------------------------------------------------------------------------------

    def check(self, value: Any) -> Any:
        """Return `value` as the Python type of this parameter, or raise ValueError with its name and range.

        Every value is taken literally: a zero is a zero, an unknown word is an error.
        """
        if of := element(self.idl):
            return self._check_sequence(of, value)
        return self._check_scalar(self.idl, value)

    def _error(self, value: Any, expected: str) -> ValueError:
        return ValueError(f"{self.name}: expected {expected}, got {short_repr(value)}")

    def _check_sequence(self, of: str, value: Any) -> list[Any]:
        items = self._items(of, value)
        if len(items) > self.most:
            raise ValueError(f"{self.name}: expected at most {self.most} values, got more")
        if not self.least and len(items) == 1 and isinstance(items[0], (int, float)) and items[0] == 0:
            items = []  # [0] means "no list", too, if the list may be empty
        checked = [self._check_scalar(of, item) for item in items]
        if len(items) < self.least:
            values = "1 value" if self.least == 1 else f"{self.least} values"
            raise ValueError(f"{self.name}: expected at least {values}, got {len(items) or 'none'}")
        if self.ascending and any(low >= high for low, high in itertools.pairwise(checked)):
            raise self._error(checked, "ascending numbers")
        return checked

    def _items(self, of: str, value: Any) -> list[Any]:
        """Return the elements of a list, at most one more than `MAX_SEQUENCE`; a single value is a list of one."""
        if value is None:
            return []
        if isinstance(value, (bytes, Mapping)) or (isinstance(value, str) and of != "string"):
            raise self._error(value, f"a list of {of}")
        if isinstance(value, str):
            return [_to_python(value)]
        try:
            return [_to_python(item) for item in itertools.islice(value, MAX_SEQUENCE + 1)]
        except TypeError:  # a single number: MATLAB users write 0 for "no list"
            return [_to_python(value)]

    def _check_scalar(self, idl: str, value: Any) -> Any:
        if idl == "string":
            return self._check_word(value)
        value = _to_python(value)
        if idl != "boolean":
            return self._check_number(idl, value)
        if isinstance(value, (bool, int, float)) and value in (0, 1):
            return bool(value)
        raise self._error(value, "a boolean")

    def _check_number(self, idl: str, value: Any) -> float:
        if not (isinstance(value, (int, float)) and is_number(value)):
            raise self._error(value, "a finite number")
        bounds = SCALARS[idl].bounds
        number = float(value) if bounds is None else int(value)
        if bounds and value != number:
            raise self._error(value, "a whole number")
        if bounds and not bounds[0] <= number <= bounds[1]:
            raise self._error(value, f"a number in the range of {idl}")
        low, high = self.minimum, self.maximum
        below = low is not None and (number < low or (self.open_minimum and number == low))
        if below or (high is not None and number > high):
            raise ValueError(f"{self.name}: expected a number {self.range_text}, got {number:.12g}")
        return number

    def _check_word(self, value: Any) -> str:
        if not isinstance(value, str):
            raise self._error(value, "a string")
        if len(value) > self.longest or "\0" in value:
            raise self._error(value, f"a text of at most {self.longest} characters")
        value = self.spellings.get(value, value)
        if self.choices and value not in self.choices:
            raise ValueError(f"{self._error(value, self.range_text)}{did_you_mean(value, self.choices)}")
        return value

    def resolve_choice(self, value: Any) -> Any:
        """Return `fallback` if there is one and `value` is an unknown word, otherwise `value` without a check."""
        if not (self.fallback and isinstance(value, str) and len(value) <= MAX_STRING and "\0" not in value):
            return value
        return value if self.spellings.get(value, value) in self.choices else self.fallback

    def substitution_warning(self, value: Any) -> str:
        """Return the warning to log if `resolve_choice` replaces `value`; empty if it does not."""
        used = self.resolve_choice(value)
        if used is value:
            return ""
        near = closest_match(value, self.choices)
        return f"{self.name}: unknown word {short_repr(value)}; {used} is used; the most similar known word is {near}"

    # --- texts ------------------------------------------------------------------------------------------------

    def parse(self, text: str, name: str = "") -> Any:
        """Convert `text` to a value by the rules of modifyParameter, without checking its range (see `check`).

        Booleans: 0, 1, true, false (blanks around are fine). Numbers: decimal or with exponent; no inf, nan or hex.
        Unsigned: digits only. Lists: numbers or words between blanks, commas, brackets or braces. `name` is the name
        of the parameter that the user has written.
        """
        text = text.strip()
        if name in self.former:
            text = text.removeprefix("_")
        if of := element(self.idl):
            for mark in "[]{}(),;":
                text = text.replace(mark, " ")
            return [self._parse_scalar(of, word) for word in text.split()]
        return self._parse_scalar(self.idl, text)

    def _parse_scalar(self, idl: str, word: str) -> Any:
        if idl == "string":
            return word
        if idl == "boolean":
            known = {"0": False, "1": True, "true": True, "false": False}
            if word not in known:
                raise self._error(word, "a boolean: 0, 1, true or false")
            return known[word]
        if SCALARS[idl].bounds is not None:
            digits = word[1:] if word.startswith(("+", "-")) else word
            if not (digits.isascii() and digits.isdigit()):
                raise self._error(word, f"a whole number ({idl})")
            if len(digits) > 30:
                raise self._error(word, f"a number in the range of {idl}")
            return int(word)
        try:
            return float(word if set(word) <= set("0123456789+-.eE") else "")
        except ValueError:
            raise self._error(word, "a number") from None

    def read(self, text: str, name: str = "") -> Any:
        """Convert `text` to a checked value: `parse`, then `check`."""
        return self.check(self.parse(text, name))


@dataclass(frozen=True)
class StructParameter(Parameter):
    """A parameter that is a structure, or a sequence of structures, with `members`; `idl` is the structure's name."""

    members: tuple[Parameter, ...] = ()

    def _check_scalar(self, idl: str, value: Any) -> Any:
        names = [member.name for member in self.members]
        if not isinstance(value, Mapping) or sorted(map(str, value)) != sorted(names):
            raise ValueError(f"{self.name}: expected an object with {', '.join(names)}, got {short_repr(value)}")
        return {member.name: member.check(value[member.name]) for member in self.members}


def _format_limit(limit: float) -> str:
    return f"{limit:d}" if isinstance(limit, int) else f"{limit:.12g}"


def format_value(value: Any) -> str:
    """Return the text that `Parameter.parse` converts to `value`, to the last digit: 1, 0.02, [100.0, 200.0], hann."""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(format_value, value))}]"
    return str(value)


# --- checks of declarations -----------------------------------------------------------------------------------------


def _bad_spellings(value: Any) -> str:
    if isinstance(value, Mapping) and all(isinstance(word, str) for pair in value.items() for word in pair):
        return ""
    return f"expected a mapping of strings to strings, got {short_repr(value)}"


_FIELDS = {
    "name": bad_name,
    **dict.fromkeys(("doc", "fallback", "unit"), bad_optional_text),
    **dict.fromkeys(("open_minimum", "zero_is_default", "follows_rate", "ascending"), bad_flag),
    **dict.fromkeys(("least", "most", "longest"), bad_count),
    "spellings": _bad_spellings,
}


def _declaration_problems(parameter: Parameter) -> Iterator[str]:
    """Yield the reasons why `parameter` is invalid, except for its default. Lists in it become tuples."""
    yield from field_problems(parameter, _FIELDS)
    if not hasattr(parameter, "members") and (problem := bad_type(parameter.idl)):
        yield f"type: {problem}"
    scalar = element(parameter.idl) or parameter.idl
    yield from _limit_problems(parameter, numeric=scalar not in ("string", "boolean"))
    yield from tuple_problems(parameter, ("choices", "aliases", "former"), str, "strings")
    yield from field_problems(parameter, {"choices": each(bad_optional_text), "aliases": each(bad_name)})
    choices, fallback = parameter.choices, parameter.fallback
    if choices and scalar != "string":
        yield f"choices: expected none for the type {parameter.idl}; only strings can have choices"
    if word := duplicate(choices):
        yield f"choices: {short_repr(word)} occurs twice"
    if choices and fallback and fallback not in choices:
        yield f"fallback: expected one of the choices, got {short_repr(fallback)}"


def _limit_problems(parameter: Parameter, numeric: bool) -> Iterator[str]:
    low, high = parameter.minimum, parameter.maximum
    for name, limit in (("minimum", low), ("maximum", high)):
        if limit is not None and not (numeric and is_number(limit)):
            yield f"{name}: expected {'a finite number or ' if numeric else ''}None, got {short_repr(limit)}"
    if low is not None and high is not None and low > high:
        yield f"minimum: {low} is above the maximum, {high}"
    if parameter.least > parameter.most:
        yield f"least: {parameter.least} is above most, {parameter.most}"
