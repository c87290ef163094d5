"""What may be changed in a module so that its tests should notice: for `tests/mutate.py`."""

from __future__ import annotations

import ast
import copy
import random
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

_TURNED: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_MOVED: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
}
_ARITHMETIC: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}
_SYMBOLS: Final = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.And: "and",
    ast.Or: "or",
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.Is: "is",
    ast.IsNot: "is not",
    ast.In: "in",
    ast.NotIn: "not in",
}
# Names of quantities that are measured: no test meets a bound of theirs to the last bit.
_MEASURED: Final = re.compile(
    r"_(m|mm|m2|px|deg|rad|s|grey|share|cells|sigma|sigmas|ratio|scale|world)$"
)
# What messages go through: nothing in these calls is mutated.
_TOLD: Final = re.compile(
    r"^(progress|warn|warning|info|debug|log|echo|secho|print|add_note|exception|error|fail)$"
)
# Arguments and names that change speed, memory or looks, not results.
_UNSEEN_KEYWORDS: Final = re.compile(
    r"^(strict|copy|cores|(n_)?threads|n_per_run|max_workers|maxsize|stacklevel|daemon|flush"
    r"|figsize|dpi|alpha|linewidths?|lw|thickness|fontsize|labelsize|(face|edge)?color|cmap|zorder"
    r"|markersize|pad|rotation_mode|interpolation|frameon|loc|ncols|capsize|hspace|wspace|description|examples"
    r"|title|help|show_default|compresslevel|quality|indent)$"
)
_UNSEEN_NAMES: Final = re.compile(
    r"AT_ONCE|PER_RUN|CHUNK|BLOCK_(POINTS|BYTES)|PART_POINTS|(SCAN|CACHE|READ)_BYTES|IN_MEMORY|_POLL"
    r"|BAND_(CELLS|PX)|_BLOCK(_ROWS|_ENTRIES)?$|_(LONGEST|SMALLEST|MAP)_PX$|PIXELS_MOST$"
    r"|_RGB$|_BGR$|_SEED$|^_?(INK|PAPER)$"
    r"|(TIMEOUT|PATIENCE|CONNECT|STOPPING|CLOSE|GRACE|LOOK|LOOK_EVERY|SILENT|PAUSE|RETRY)_S$"
    r"|(ROWS|VOXELS)_FIRST$|ITERATIONS|ROUNDS|CONVERGED|NICENESS|(STEPS|PASSES|SWEEPS|PROCESSES)_MOST|THREADS$|^(result_version|citations|cores|threads)$"
)
# What lays out a drawing, and how a made-up surface looks.
_LOOKS: Final = re.compile(r"^(Margins|Paint)$")
# Decorators of compiled functions, and what makes the arrays that they write their sums to.
_COMPILED: Final = frozenset({"compiled", "kernel_part"})
_ROOM: Final = frozenset({"empty", "zeros"})
# From how many on a part is looked at in place of all: no quick test has so many.
_SIZES: Final = re.compile(r"(MOST|TOLD|ASKED|FIRST)$")
_MANY: Final = 100_000
_GUARD: Final = 1e-6
_LARGE: Final = 100


@dataclass(frozen=True, kw_only=True)
class Mutation:
    """One change of one place.

    Attributes:
        path: of the module, from the root.
        line: where the change begins.
        kind: the operator.
        change: what becomes of it, for people.
        first: byte in the file where the changed text begins.
        last: and where it ends.
        text: what stands there instead.
    """

    path: str
    line: int
    kind: str
    change: str
    first: int
    last: int
    text: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line} {self.kind}: {self.change}"

    def applied(self, source: bytes) -> bytes:
        """Give the module with the change."""
        return source[: self.first] + self.text.encode() + source[self.last :]


def mutations_of(source: bytes, path: str) -> list[Mutation]:
    """Give everything that may be done to a module, in the order of its text."""
    found = _Finder(source, path)
    found.visit(ast.parse(source))
    return sorted(found.mutations, key=lambda item: (item.first, item.last, item.text))


def drawn(mutations: Sequence[Mutation], *, seed: int, count: int) -> list[Mutation]:
    """Draw places, each line as likely as any other, and one mutation at each."""
    places: dict[tuple[str, int], list[Mutation]] = defaultdict(list)
    for mutation in mutations:
        places[mutation.path, mutation.line].append(mutation)
    rng = random.Random(seed)
    chosen = rng.sample(sorted(places), min(count, len(places)))
    return [rng.choice(places[place]) for place in chosen]


class _Finder(ast.NodeVisitor):
    """Walks a module; the names of its methods are those of ast's nodes."""

    def __init__(self, source: bytes, path: str) -> None:
        self.mutations: list[Mutation] = []
        self._path = path
        self._source = source
        self._is_compiled = False
        self._starts = [0]
        for text in source.splitlines(keepends=True):
            self._starts.append(self._starts[-1] + len(text))

    # --- what is left alone ---

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):
            self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        """Leave the message alone."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """Leave alone what cannot happen."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Leave text alone."""

    def visit_Call(self, node: ast.Call) -> None:
        name = _name_of(node.func)
        # Any negative length means the one that is left.
        is_flat = name == "reshape" and any(ast.unparse(item) == "-1" for item in node.args)
        is_told = _TOLD.match(name) or name.endswith(("Error", "Warning"))
        if is_told or _LOOKS.match(name) or is_flat:
            return
        if self._is_compiled and name in _ROOM:
            # Of arrays that a kernel makes for itself one more row is more room, and no more.
            for part in _shape_of(node):
                if not isinstance(part, ast.Constant):
                    self.visit(part)
            return
        self.generic_visit(node)

    def visit_keyword(self, node: ast.keyword) -> None:
        if not _UNSEEN_KEYWORDS.match(node.arg or ""):
            self.visit(node.value)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for item in node.body:
            self.visit(item)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.name == "__repr__":
            return
        args = node.args
        positional = [*args.posonlyargs, *args.args]
        names = [*positional[len(positional) - len(args.defaults) :], *args.kwonlyargs]
        for named, default in zip(names, [*args.defaults, *args.kw_defaults], strict=True):
            if default is not None and not _UNSEEN_NAMES.search(named.arg):
                self.visit(default)
        self._is_compiled = any(_name_of(item) in _COMPILED for item in node.decorator_list)
        for item in node.body:
            self.visit(item)
        self._is_compiled = False

    def visit_Assign(self, node: ast.Assign) -> None:
        if not any(_is_unseen(target, node.value) for target in node.targets):
            self.visit(node.value)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None and not _is_unseen(node.target, node.value):
            self.visit(node.value)

    # --- what is changed ---

    def visit_If(self, node: ast.If) -> None:
        if _name_of(node.test) == "TYPE_CHECKING":
            return
        self._branch(node.test)
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._branch(node.test)
        self.generic_visit(node)

    def visit_Return(self, node: ast.Return) -> None:
        value = node.value
        if value is None:
            return
        if not (isinstance(value, ast.Constant) and value.value is None):
            self._add(value, "return", "None", ast.Constant(value=None))
        self.visit(value)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        other = _ARITHMETIC.get(type(node.op))
        if other is not None and not any(map(_is_text, (node.left, node.right))):
            change = f"{_SYMBOLS[type(node.op)]} -> {_SYMBOLS[other]}"
            self._add(node, "arithmetic", change, _with(node, op=other()))
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        other = _ARITHMETIC.get(type(node.op))
        if other is not None and not isinstance(node.value, ast.List) and not _is_text(node.value):
            change = f"{_SYMBOLS[type(node.op)]}= -> {_SYMBOLS[other]}="
            self._add(node, "arithmetic", change, _with(node, op=other()))
        self.visit(node.value)

    def visit_Compare(self, node: ast.Compare) -> None:
        sides = [node.left, *node.comparators]
        for place, operator in enumerate(node.ops):
            turned = [_TURNED[type(operator)]]
            if type(operator) in _MOVED and not any(map(_is_measured, sides[place : place + 2])):
                turned.append(_MOVED[type(operator)])
            for other in turned:
                ops = [*node.ops[:place], other(), *node.ops[place + 1 :]]
                change = f"{_SYMBOLS[type(operator)]} -> {_SYMBOLS[other]}"
                self._add(node, "comparison", change, _with(node, ops=ops))
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        other = ast.Or if isinstance(node.op, ast.And) else ast.And
        change = f"{_SYMBOLS[type(node.op)]} -> {_SYMBOLS[other]}"
        self._add(node, "boolean", change, _with(node, op=other()))
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.Not):
            self._add(node, "boolean", "not left out", node.operand)
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            other: object = not value
        elif isinstance(value, int):
            other = 2 * value if value >= _LARGE else value + 1
        elif isinstance(value, float) and not 0.0 < abs(value) <= _GUARD:
            other = 2.0 * value if value else 1.0
        else:
            return
        if other != value:
            self._add(node, "constant", f"{value!r} -> {other!r}", ast.Constant(value=other))

    def _branch(self, test: ast.expr) -> None:
        for taken in (True, False):
            words = f"{'always' if taken else 'never'} taken: if {ast.unparse(test)}"
            self._add(test, "branch", _shortened(words), ast.Constant(value=taken))

    def _add(self, node: ast.expr | ast.stmt, kind: str, change: str, other: ast.AST) -> None:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        text = ast.unparse(ast.fix_missing_locations(other))
        self.mutations.append(
            Mutation(
                path=self._path,
                line=node.lineno,
                kind=kind,
                change=change,
                first=self._starts[node.lineno - 1] + node.col_offset,
                last=self._starts[node.end_lineno - 1] + node.end_col_offset,
                text=text if isinstance(node, ast.stmt) else f"({text})",
            )
        )


def _with(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _name_of(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _shape_of(node: ast.Call) -> list[ast.expr]:
    """The sides of the array that a call makes."""
    shape = node.args[0]
    return list(shape.elts) if isinstance(shape, ast.Tuple) else [shape]


def _is_unseen(target: ast.expr, value: ast.expr) -> bool:
    """Whether what a name stands for changes speed, memory or looks alone."""
    name = _name_of(target)
    if _UNSEEN_NAMES.search(name):
        return True
    if isinstance(value, ast.BinOp) and isinstance(value.op, ast.LShift):
        # 1 << 22
        return bool(_SIZES.search(name))
    number = value.value if isinstance(value, ast.Constant) else 0
    return bool(_SIZES.search(name)) and isinstance(number, int) and number >= _MANY


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)
    )


def _is_measured(node: ast.expr) -> bool:
    for part in ast.walk(node):
        if isinstance(part, ast.Constant) and isinstance(part.value, float):
            return True
        if isinstance(part, ast.Name | ast.Attribute) and _MEASURED.search(_name_of(part).lower()):
            return True
    return False


def _shortened(text: str) -> str:
    return text if len(text) <= 90 else f"{text[:87]}..."
