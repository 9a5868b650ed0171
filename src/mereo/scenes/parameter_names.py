"""Names of draws, from the source lines that make them: ``head = HEAD_JOINT.sample(rng)`` is "head".

Nothing depends on these names but the labels of sliders, so that a scene without readable source loses only those.
"""

import ast
import linecache
import re
from collections.abc import Iterator
from functools import cache
from types import CodeType

from mereo.scenes.draw_recorder import Trail

GENERIC = {"sample", "draw", "make", "random"}
"""Methods whose own name says nothing; what their result is called does."""

UNITS = {"rad": "°", "deg": "°", "mm": " mm", "m": " m"}
"""By the suffix of the name that bounds a draw, see docs/conventions.md."""


def name_of(trail: Trail) -> tuple[str, str, str]:
    """Group, name and unit of a draw. The unit is "" where the name in the source has no suffix for it."""
    steps = [step for step in trail if not re.fullmatch("<(list|set|dict)comp>|<genexpr>", step[0].co_name)]
    # up to Python 3.11 a comprehension is a call of its own: its place is the one that counts
    places = _innermost_places(trail)
    calls = [_call_at(code, instruction) for code, instruction in places]
    labels = [_step_label(call, steps[k + 1][0]) for k, call in enumerate(calls[:-1])]
    own, unit = _own_name(calls[-1]) if calls else ("", "")
    if not own and len(calls) > 1:  # a helper that only draws: what its result becomes, else its own name
        own = _context(calls[-2]) or labels[-1]
        labels = labels[:-1] or labels
    words = [label for label in labels if label]
    group, rest = (words[0], words[1:]) if words else ("whole", [])
    name = " ".join([*rest, own]).strip() or (_readable(steps[-1][0].co_name) if steps else "")
    return group, _without_repeats(name) or group, unit


def _innermost_places(trail: Trail) -> list[tuple[CodeType, int]]:
    places: list[tuple[CodeType, int]] = []
    for code, instruction in trail:
        if places and re.fullmatch("<(list|set|dict)comp>|<genexpr>", code.co_name):
            places.pop()
        places.append((code, instruction))
    return places


def _step_label(call: "_Call | None", callee: CodeType) -> str:
    """What one call on the way to a draw is about."""
    owner = callee.co_qualname.rpartition(".")[0].rpartition(".")[2].replace("<locals>", "")
    if callee.co_name == "__call__":
        return _readable(re.sub("^Draw", "", owner))
    if callee.co_name not in GENERIC:
        return " ".join([_readable(callee.co_name), *(call.texts if call else ())])
    return (_context(call) if call else "") or _readable(owner)


def _own_name(call: "_Call | None") -> tuple[str, str]:
    """Name and unit of the draw itself: of its bound, as ``bend_rad`` in ``uniform(0, self.bend_rad)``, else of what it
    becomes.
    """
    if call is None:
        return "", ""
    if not call.bounds:
        return _context(call), _unit(call.becomes) if call.direct else ""
    return _readable(call.bounds[0]), _unit(call.bounds[0])


def _unit(name: str) -> str:
    return UNITS.get(name.lower().rpartition("_")[2], "") if "_" in name else ""


def _context(call: "_Call | None") -> str:
    """The variable, keyword or class that takes a call's result; "" where there is none."""
    return _readable(call.becomes) if call else ""


def _readable(name: str) -> str:
    """``sample_jaw``, ``SmoothField`` and ``COIL_PITCH`` as words."""
    words = re.sub("(?<=[a-z])(?=[A-Z])", "_", name).lower().removeprefix("_").removeprefix("sample_")
    return re.sub("_(rad|deg|mm|m|at)$", "", words).strip("_").replace("_", " ")


def _without_repeats(name: str) -> str:
    words = name.split()
    return " ".join(word for k, word in enumerate(words) if k == 0 or word != words[k - 1])


# --- the source -------------------------------------------------------------------------------------------------------


class _Call:
    """A call in the source: texts given to it, names that bound it, what its result becomes, and whether directly."""

    def __init__(self, node: ast.Call, parents: "_Parents", functions: "_Functions") -> None:
        self.texts = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
        self.bounds = list(_bounds(node, parents))
        self.becomes = _becomes(node, parents, functions)
        self.direct = isinstance(parents.get(node), ast.Call | ast.keyword)


_Parents = dict[ast.AST, ast.AST]
_Functions = dict[str, list[str]]
"""Parameters of the functions of a file."""


def _bounds(node: ast.Call, parents: _Parents) -> Iterator[str]:
    """Constants and attributes of ``self`` among the arguments; what a bare ``random()`` is compared with."""
    parent = parents.get(node)
    where: list[ast.AST] = [*node.args]
    if isinstance(parent, ast.Compare):
        where += parent.comparators
    for part in where:
        for inner in ast.walk(part):
            if isinstance(inner, ast.Attribute) and isinstance(inner.value, ast.Name) and inner.value.id == "self":
                yield inner.attr
            elif isinstance(inner, ast.Name) and inner.id.isupper():
                yield inner.id


def _becomes(node: ast.AST, parents: _Parents, functions: _Functions) -> str:
    """A keyword, a parameter, a class or a variable, whichever takes the value first."""
    place: int | None = None
    child = node
    while (parent := parents.get(child)) is not None:
        if isinstance(parent, ast.keyword):
            return parent.arg or ""
        if isinstance(parent, ast.Tuple):
            place = parent.elts.index(child)  # type: ignore[arg-type]
        if isinstance(parent, ast.Call) and child is not parent.func:
            callee = parent.func.attr if isinstance(parent.func, ast.Attribute) else getattr(parent.func, "id", "")
            if callee[:1].isupper():
                return callee
            taken = functions.get(callee, [])
            if child in parent.args[: len(taken)] and not any(isinstance(a, ast.Starred) for a in parent.args):
                return taken[parent.args.index(child)]
        if isinstance(parent, ast.Assign | ast.AnnAssign | ast.AugAssign):
            return _target(parent.targets[0] if isinstance(parent, ast.Assign) else parent.target, place)
        if isinstance(parent, ast.stmt):
            return ""
        child = parent
    return ""


def _target(target: ast.expr, place: int | None) -> str:
    if isinstance(target, ast.Tuple) and place is not None and place < len(target.elts):
        target = target.elts[place]
    return target.id if isinstance(target, ast.Name) else ""


@cache
def _calls(file: str) -> dict[tuple[int, int], list[tuple[tuple[int, int], _Call]]]:
    """The calls of a file by where they end; each with where it starts."""
    try:
        tree = ast.parse("".join(linecache.getlines(file)))
    except SyntaxError:
        return {}
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    functions = {n.name: [a.arg for a in n.args.args] for n in tree.body if isinstance(n, ast.FunctionDef)}
    found: dict[tuple[int, int], list[tuple[tuple[int, int], _Call]]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            end = (node.end_lineno or 0, node.end_col_offset or 0)
            found.setdefault(end, []).append(((node.lineno, node.col_offset), _Call(node, parents, functions)))
    return found


def _call_at(code: CodeType, instruction: int) -> _Call | None:
    """The call that an instruction makes; calls that end at the same place are told apart by their start."""
    line, last_line, column, last_column = list(code.co_positions())[instruction // 2]
    if line is None or last_line is None or column is None or last_column is None:
        return None
    calls = _calls(code.co_filename).get((last_line, last_column), [])
    exact = [call for start, call in calls if start == (line, column)]
    return exact[0] if exact else calls[0][1] if calls else None
