"""Parameters: type, default, range and words of one value that a user can set, and every way to read such a value."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosafe.declarations.checks import as_tuple, bad_name, bad_text, is_number, short, twice
from rosafe.declarations.idl import SCALARS, element, ros_type
from rosafe.declarations.text import closest_matches, did_you_mean

REQUIRED = object()  # a parameter without a default, such as connect_port's `local`
MAX_STRING = 4096  # characters in any string that a request carries
MAX_SEQUENCE = 1024  # elements in any list that a request carries, and channels of a filterbank


def _to_python(value: Any) -> Any:
    """A number of numpy's, or an array without dimensions, as Python's own type; NaN if it is masked."""
    if not hasattr(value, "item") or getattr(value, "ndim", 1) != 0:
        return value
    return math.nan if getattr(value, "mask", False) else value.item()


def short_repr(value: Any) -> str:
    """`value` for a message of one line, not too long."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


@dataclass(frozen=True)
class Parameter:
    """One member of a request, or one parameter of a processor.

    `minimum` and `maximum` are inclusive unless `open_minimum` says otherwise; they bind the elements of a sequence,
    `least` and `most` its length, `longest` the characters of a text. `choices` are the known words of an enumerated
    string, or of a list of words.
    Requests from the ROS graph may hold any word. `resolve_choice` replaces an unknown one by the original's
    `fallback`; without a fallback it is rejected, as everywhere else.
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
    aliases: tuple[str, ...] = ()  # further names, good everywhere
    former: tuple[str, ...] = ()  # the original's misspelt names of modifyParameter, which go with words like `_power`
    spellings: Mapping[str, str] = field(default_factory=dict, hash=False)  # known slips: jespen is jepsen
    unit: str = ""
    least: int = 0
    most: int = MAX_SEQUENCE
    longest: int = MAX_STRING
    zero_is_default: bool = True  # in ROS requests, which carry no defaults
    follows_rate: bool = False  # where it is not given, the sample rate may make another one of the default
    checked_by_client: bool = False  # as the component, for which it is a number, cannot name what is allowed

    def __post_init__(self) -> None:
        for problem in self._problems():
            raise ValueError(f"parameter {short(self.name)}: {problem}")

    def _problems(self) -> Iterator[str]:
        if problem := bad_name(self.name):
            yield f"name: {problem}"
        if problem := self._bad_type():
            yield f"type: {problem}"
        if problem := bad_text(self.doc, empty=True):
            yield f"doc: {problem}"
        for name in ("fallback", "unit"):
            if problem := bad_text(getattr(self, name), empty=True):
                yield f"{name}: {problem}"
        for name in ("open_minimum", "zero_is_default", "follows_rate"):
            if not isinstance(getattr(self, name), bool):
                yield f"{name}: expected True or False, got {short(getattr(self, name))}"
        yield from self._bad_limits()
        yield from self._bad_words()
        if self.default is not REQUIRED:
            try:
                checked = self.check(self.default)
            except ValueError as problem:
                yield f"default: {problem}"
            if element(self.idl) and not isinstance(self.default, tuple):
                object.__setattr__(self, "default", tuple(checked))  # a list can change, and has no hash

    def _bad_type(self) -> str:
        if isinstance(self.idl, str) and (element(self.idl) or self.idl) in SCALARS:
            return ""
        return f"expected one of {', '.join(SCALARS)} or sequence<one of them>, got {short(self.idl)}"

    def _bad_limits(self) -> Iterator[str]:
        numeric = (element(self.idl) or self.idl) not in ("string", "boolean")
        for name in ("minimum", "maximum"):
            limit = getattr(self, name)
            if limit is not None and not (numeric and is_number(limit)):
                yield f"{name}: expected {'a finite number or ' if numeric else ''}None, got {short(limit)}"
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            yield f"minimum: {self.minimum} is above the maximum, {self.maximum}"
        for name in ("least", "most", "longest"):
            if type(getattr(self, name)) is not int or getattr(self, name) < 0:
                yield f"{name}: expected a count, got {short(getattr(self, name))}"
        if self.least > self.most:
            yield f"least: {self.least} is above most, {self.most}"

    def _bad_words(self) -> Iterator[str]:
        for name in ("choices", "aliases", "former"):
            if problem := as_tuple(self, name, str, "strings"):
                yield problem
        if self.choices and (element(self.idl) or self.idl) != "string":
            yield f"choices: only a string has any, not {self.idl}"
        for word in self.choices:
            if problem := bad_text(word, empty=True):
                yield f"choices: {problem}"
        if word := twice(self.choices):
            yield f"choices: {short(word)} occurs twice"
        if self.choices and self.fallback and self.fallback not in self.choices:
            yield f"fallback: expected one of the choices, got {short(self.fallback)}"
        for name in self.aliases:
            if problem := bad_name(name):
                yield f"aliases: {problem}"
        if not isinstance(self.spellings, Mapping) or not all(
            isinstance(word, str) for pair in self.spellings.items() for word in pair
        ):
            yield f"spellings: expected a mapping of strings to strings, got {short(self.spellings)}"

    @property
    def ros(self) -> str:
        """The type of its field in a ROS message."""
        return ros_type(self.idl)

    @property
    def range_text(self) -> str:
        """The range in words, for help texts and error messages; empty where anything goes."""
        if self.choices:
            named = ", ".join(filter(None, self.choices))
            return f"one of {named}" + (", or empty" if "" in self.choices else "")
        low, high = self.minimum, self.maximum
        if low is None and high is None:
            return ""
        if high is None:
            return f"{'more than' if self.open_minimum else 'at least'} {low:.12g}"
        if low is None:
            return f"at most {high:.12g}"
        return f"{'more than' if self.open_minimum else 'from'} {low:.12g} to {high:.12g}"

    # --- values -----------------------------------------------------------------------------------------------

    def check(self, value: Any) -> Any:
        """`value` as this parameter's Python type, or ValueError naming the parameter and what is allowed.

        Every value is taken literally: a zero is a zero, an unknown word is refused.
        """
        if of := element(self.idl):
            return self._check_sequence(of, value)
        return self._check_scalar(self.idl, value)

    def _refuse(self, value: Any, wanted: str) -> ValueError:
        return ValueError(f"{self.name}: {short_repr(value)} is not {wanted}")

    def _check_sequence(self, of: str, value: Any) -> list[Any]:
        if of == "string" and isinstance(value, str):  # a single word is a list of one
            value = [value]
        if isinstance(value, (str, bytes, Mapping)):
            raise self._refuse(value, f"a list of {of}")
        try:
            items = (
                [_to_python(item) for item in itertools.islice(value, MAX_SEQUENCE + 1)] if value is not None else []
            )
        except TypeError:  # a single number is a list of one: MATLAB users write 0 for "no list"
            items = [_to_python(value)]
        if len(items) > self.most:
            raise ValueError(f"{self.name}: too many values, at most {self.most}")
        if not self.least and len(items) == 1 and isinstance(items[0], (int, float)) and items[0] == 0:
            items = []  # [0] is "no list" likewise, where there may be none
        checked = [self._check_scalar(of, item) for item in items]
        if len(items) < self.least:
            told = "1 value" if len(items) == 1 else f"{len(items) or 'no'} values"
            raise ValueError(f"{self.name}: {told}, wanted are {self.least}")
        return checked

    def _check_scalar(self, idl: str, value: Any) -> Any:
        if idl == "string":
            return self._check_word(value)
        value = _to_python(value)
        if idl == "boolean":
            if isinstance(value, (bool, int, float)) and value in (0, 1):
                return bool(value)
            raise self._refuse(value, "a boolean")
        try:
            number = float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
        except OverflowError:
            number = math.nan
        if not math.isfinite(number):
            raise self._refuse(value, "a finite number")
        bounds = SCALARS[idl].bounds
        if bounds is None:
            self._check_range(number)
            return number
        if number != int(number):
            raise self._refuse(value, "a whole number")
        whole = int(value)
        if not bounds[0] <= whole <= bounds[1]:
            raise self._refuse(value, f"in the range of {idl}")
        self._check_range(whole)
        return whole

    def _check_word(self, value: Any) -> str:
        if not isinstance(value, str):
            raise self._refuse(value, "a string")
        if len(value) > self.longest or "\0" in value:
            raise self._refuse(value, f"a text of at most {self.longest} characters")
        value = self.spellings.get(value, value)
        if self.choices and value not in self.choices:
            raise self._refuse(value, self.range_text + did_you_mean(value, self.choices))
        return value

    def _check_range(self, number: float) -> None:
        low, high = self.minimum, self.maximum
        below = low is not None and (number < low or (self.open_minimum and number == low))
        if below or (high is not None and number > high):
            raise ValueError(f"{self.name}: {number:.12g} is out of range, allowed is {self.range_text}")

    def resolve_choice(self, value: Any) -> Any:
        """What is taken for `value` where any word goes: itself where it is known, else the `fallback`.

        Anything but an unknown word, and any word where there is no fallback, is left to `check`.
        """
        word = isinstance(value, str) and len(value) <= MAX_STRING and "\0" not in value
        return (
            self.fallback if self.fallback and word and self.spellings.get(value, value) not in self.choices else value
        )

    def substitution_warning(self, value: Any) -> str:
        """What is to be told where `resolve_choice` takes another word for `value`; empty where it takes that."""
        taken = self.resolve_choice(value)
        if taken is value:
            return ""
        near = closest_matches(value, self.choices)
        return f"{self.name}: {short_repr(value)} is no known word, {taken} is taken; the nearest known one is {near}"

    # --- texts ------------------------------------------------------------------------------------------------

    def parse(self, text: str, name: str = "") -> Any:
        """The value that `text` says, by modifyParameter's rules, not yet checked for its range (see `check`).

        Booleans: 0, 1, true, false (blanks around are fine). Numbers: decimal or with exponent; no inf, nan or hex.
        Unsigned: digits only. Lists: numbers or words between blanks, commas, brackets or braces. `name` is what the
        user calls the parameter.
        """
        words = text.strip()
        if name in self.former:
            words = words.removeprefix("_")
        if of := element(self.idl):
            for mark in "[]{}(),;":
                words = words.replace(mark, " ")
            return [self._parse_scalar(of, word) for word in words.split()]
        return self._parse_scalar(self.idl, words)

    def _parse_scalar(self, idl: str, words: str) -> Any:
        if idl == "string":
            return words
        if idl == "boolean":
            known = {"0": False, "1": True, "true": True, "false": False}
            if words not in known:
                raise self._refuse(words, "a boolean: 0, 1, true or false")
            return known[words]
        if SCALARS[idl].bounds is not None:
            digits = words[1:] if words[:1] in "+-" and words[:1] else words
            if not (digits.isascii() and digits.isdigit()):
                raise self._refuse(words, f"a whole number ({idl})")
            if len(digits) > 30:
                raise self._refuse(words, f"in the range of {idl}")
            return int(words)
        if not words or any(c not in "0123456789+-.eE" for c in words):
            raise self._refuse(words, "a number")
        try:
            return float(words)
        except ValueError:
            raise self._refuse(words, "a number") from None

    def read(self, text: str, name: str = "") -> Any:
        """`parse` and `check`: the value that a literal text says, or ValueError."""
        return self.check(self.parse(text, name))


@dataclass(frozen=True)
class StructParameter(Parameter):
    """A parameter that is a structure, or a sequence of structures, with `members`."""

    members: tuple[Parameter, ...] = ()

    def _bad_type(self) -> str:
        return ""  # the structure's name

    def _check_scalar(self, idl: str, value: Any) -> Any:
        names = [member.name for member in self.members]
        if not isinstance(value, Mapping) or sorted(map(str, value)) != sorted(names):
            raise ValueError(f"{self.name}: expected an object with {', '.join(names)}, got {short_repr(value)}")
        return {member.name: member.check(value[member.name]) for member in self.members}


def format_value(value: Any) -> str:
    """The text that `Parameter.parse` reads as `value`, to the last digit: 1, 0.02, [100.0, 200.0], hann."""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(format_value, value))}]"
    return str(value)
