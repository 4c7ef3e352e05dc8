"""Types of command-line options for argparse: each converts a text, or names the values that it accepts."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

MAX_PORT = 65535


def whole_number(minimum: int, maximum: float, noun: str = "a whole number") -> Callable[[str], int]:
    """Return a type for whole numbers from `minimum` to `maximum`, written in ASCII digits without a sign."""

    def convert(text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) <= 20 and minimum <= int(text) <= maximum):
            raise argparse.ArgumentTypeError(f"expected {noun} from {minimum} to {maximum:.0f}, got {text!r}")
        return int(text)

    return convert


def number(minimum: float, maximum: float, noun: str) -> Callable[[str], float]:
    """Return a type for numbers from `minimum` to `maximum`; `noun` is the name of the quantity."""

    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not minimum <= value <= maximum:
            raise argparse.ArgumentTypeError(f"expected {noun} from {minimum:g} to {maximum:g}, got {text!r}")
        return value

    return convert


def seconds(minimum: float, maximum: float) -> Callable[[str], float]:
    """Return a type for durations in s."""
    return number(minimum, maximum, "a number of seconds")


def port(minimum: int = 0) -> Callable[[str], int]:
    """Return a type for TCP ports; a `minimum` of 0 also accepts 0, which stands for any free port."""
    return whole_number(minimum, MAX_PORT, "a TCP port")
