"""Numbers as the page prints them."""

from __future__ import annotations

import math
from typing import Final

_DIGITS_MOST: Final = 6  # of a mean beside its spread
_DIGITS_FEW: Final = 4


def number(value: float, *, significant: int = 4) -> str:
    """Print a number with four significant digits, without an exponent where one can.

    >>> number(0.0123456), number(1234567.0), number(12.0), number(0.14151, significant=2)
    ('0.01235', '1234567', '12', '0.14')
    """
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    digits = max(0, significant - 1 - math.floor(math.log10(abs(value))))
    if digits >= 10:
        return f"{value:.3g}"
    printed = f"{value:.{digits}f}"
    # Zeros before the point count.
    return printed.rstrip("0").rstrip(".") if digits else printed


def number_with_unit(value: float, unit: str, *, significant: int = 4) -> str:
    """Print a number and its unit; shares and counts (unit 1) stand alone.

    >>> number_with_unit(2.5, "mm"), number_with_unit(1.0, "yes/no"), number_with_unit(0.4, "1")
    ('2.5 mm', 'yes', '0.4')
    """
    if unit == "yes/no" and value in (0.0, 1.0):
        return "yes" if value else "no"
    printed = number(value, significant=significant)
    return printed if unit == "1" else f"{printed} {unit}"


def number_with_spread(value: float, spread: float) -> str:
    """Print a mean and its standard deviation, to the latter's second digit where that is sane.

    >>> number_with_spread(12.3456, 0.0123), number_with_spread(3.0, 0.0)
    ('12.346 ± 0.012', '3')
    >>> number_with_spread(281.999858, 0.000022)
    '282.0 ± 2e-05'
    """
    if spread == 0.0:
        return number(value)
    decimals = 1 - math.floor(math.log10(spread))
    magnitude = math.floor(math.log10(max(abs(value), spread)))
    if decimals + magnitude >= _DIGITS_MOST:
        return f"{value:#.{_DIGITS_FEW}g} ± {spread:.1g}"
    if decimals < 0:
        return f"{number(value)} ± {number(spread)}"
    return f"{value:.{decimals}f} ± {spread:.{decimals}f}"


def seconds_in_words(seconds: float) -> str:
    """Print a time.

    >>> seconds_in_words(0.042), seconds_in_words(12.34), seconds_in_words(125.0)
    ('0.04 s', '12.3 s', '2 min 05 s')
    """
    if seconds < 10:
        return f"{seconds:.2f} s"
    if seconds < 60:
        return f"{seconds:.1f} s"
    return "{} min {:02d} s".format(*divmod(round(seconds), 60))
