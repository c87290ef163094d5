"""What stands under pictures of walls: how long a metre is, and which colour is which depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Final

_ROUND: Final = (1.0, 2.0, 5.0)
# A bar takes this share of the picture's width, at most.
_BAR_SHARE: Final = 0.3
_GRADIENT: Final = "depth-colours"


def scale_bar(width_m: float) -> str:
    """Draw a bar of a round length as an `<svg>` element that is as wide as the picture.

    Args:
        width_m: of the picture on the wall, metres.
    """
    length_m = round_length_m(_BAR_SHARE * width_m)
    share = 100.0 * length_m / width_m
    words = length_words(length_m)
    return (
        f'<svg class="legend" width="100%" height="20" role="img" aria-label="scale: the bar is '
        f'{words}"><rect class="ink" x="1" y="3" width="{share:.3f}%" height="4"/>'
        f'<text x="{share:.3f}%" dx="7" y="11">{words}</text></svg>'
    )


def round_length_m(most_m: float) -> float:
    """Return the largest of 1, 2, 5, 10 ... that is no longer.

    >>> round_length_m(3.1), round_length_m(0.07)
    (2.0, 0.05)
    """
    power = 10.0 ** math.floor(math.log10(most_m))
    return float(f"{power * max(step for step in _ROUND if step * power <= most_m):.1g}")


def length_words(length_m: float) -> str:
    """State a round length.

    >>> length_words(0.05), length_words(2.0)
    ('5 cm', '2 m')
    """
    return f"{length_m:g} m" if length_m >= 1.0 else f"{100.0 * length_m:g} cm"


def depth_gradient(colours: Sequence[Sequence[float]]) -> str:
    """Return the colours of depth as an `<svg>` element, which a page holds once.

    Args:
        colours: red, green and blue, 0 to 255, at equal distances.
    """
    stops = "".join(
        f'<stop offset="{place / (len(colours) - 1):.3f}" '
        f'stop-color="rgb({",".join(f"{part:.0f}" for part in colour)})"/>'
        for place, colour in enumerate(colours)
    )
    return (
        '<svg class="hidden" aria-hidden="true"><defs>'
        f'<linearGradient id="{_GRADIENT}">{stops}</linearGradient></defs></svg>'
    )


def depth_bar(limit_m: float) -> str:
    """Draw which colour stands for which depth as an `<svg>` element.

    It is as wide as the picture, or as its own words.

    Args:
        limit_m: depth of the last colour, metres; the first stands for as much behind the plane.
    """
    limit = f"{1000.0 * limit_m:.0f} mm"
    label = escape(f"colours: blue is {limit} behind the plane, white on it, red {limit} before it")
    ticks = "".join(
        f'<text x="{place}" y="27" text-anchor="{anchor}">{text}</text>'
        for place, anchor, text in (
            ("0", "start", f"-{limit} (behind)"),
            ("50%", "middle", "0"),
            ("100%", "end", f"+{limit} (before)"),
        )
    )
    return (
        f'<svg class="legend depths" width="100%" height="32" role="img" aria-label="{label}">'
        f'<rect x="0" y="2" width="100%" height="11" fill="url(#{_GRADIENT})" class="frame"/>'
        f"{ticks}</svg>"
    )
