"""Template environment for pages and drawings."""

from __future__ import annotations

import base64
import hashlib
import re
import shlex
from functools import cache
from importlib.resources import files
from typing import Final
from urllib.parse import quote

import jinja2
from markupsafe import Markup, escape

from orthoflow.records import COSTS
from orthoflow.report.combinations import distinct_words
from orthoflow.report.pictures import DIVERGING
from orthoflow.report.rankings import BETTER, Mark, number, number_with_unit
from orthoflow.untrusted_text import shown
from orthoflow.version import __version__

# A DOI may contain pairs of parentheses, as in doi:10.1007/3DRes.02(2011)3.
_DOI: Final = re.compile(r"doi:\s*(10\.(?:\([^\s()]*\)|[^\s,;()])*(?:\([^\s()]*\)|[^\s,;().]))")


@cache
def environment() -> jinja2.Environment:
    """Return the Jinja environment with the functions and values that all pages use."""
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=_shown,
        loader=jinja2.PackageLoader("orthoflow.report"),
    )
    environment.filters |= {
        "with_unit": number_with_unit,
        "number": number,
        "environments": distinct_words,
        "cited": cited,
        # In long names and addresses, allow line breaks after underscores and before each variant.
        "breakable": lambda name: Markup(re.sub(r"([_@,])", r"\1<wbr>", str(escape(shown(name))))),
        "urlpath": quote,
        "shell": shlex.quote,
    }
    # Insert these files unchanged; they are not templates, so braces have no special meaning.
    folder = files("orthoflow.report") / "templates"
    css, early, script = (
        folder.joinpath(name).read_text(encoding="utf-8")
        for name in ("page.css", "early.js", "page.js")
    )
    environment.globals |= {
        "better": BETTER,
        "costs": COSTS,
        "marks": (Mark.BEST, Mark.NEAR),
        "version": __version__,
        "depth_colours": DIVERGING.tolist(),
        "css": Markup(css),
        "early_script": Markup(early),
        "script": Markup(script),
        "policy": "default-src 'none'; img-src data:; "
        f"style-src {_hash_source(css)}; script-src {_hash_source(early)} {_hash_source(script)}; "
        "base-uri 'none'; form-action 'none'",
    }
    return environment


def _shown(value: object) -> object:
    """Escape control characters, such as text direction marks, except in markup."""
    is_text = isinstance(value, str) and not isinstance(value, Markup)
    return shown(str(value), keep="\n\t") if is_text else value


def _hash_source(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def cited(citation: str) -> Markup:
    """Escape a citation and turn its DOI into a link, which uses the network only when clicked."""
    return Markup(
        _DOI.sub(
            lambda found: (
                f'<a href="https://doi.org/{quote(found[1], safe="/.()-;")}">doi:{found[1]}</a>'
            ),
            str(escape(shown(citation))),
        )
    )
