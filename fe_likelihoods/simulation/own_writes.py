"""What the code of a function may itself change when it runs: a counter, a table of earlier results, a kept solver.

The bytecode names the globals and closure variables that a function assigns. The source text names the attributes that
it assigns, and the containers whose items it changes. Where there is no source text, every name in a function that
changes some container counts. A digest without these values (`fe_likelihoods.simulation.code_digest`) differs only if
somebody else has changed the model.

Assignments to ``self`` in methods that construct an object do not count, because they happen before it is used.
"""

import ast
import dis
import functools
import inspect
import textwrap
import types
from collections.abc import Iterator
from typing import NamedTuple

__all__ = ["Writes", "writes_of"]

_CONSTRUCTORS = {"__init__", "__post_init__", "__new__", "__setstate__", "__set_name__", "__init_subclass__"}
_CHANGING_METHODS = {
    *("append", "appendleft", "add", "clear", "discard", "extend", "extendleft", "insert", "pop", "popitem", "popleft"),
    *("remove", "reverse", "rotate", "setdefault", "sort", "subtract", "update", "fill", "itemset", "put", "resize"),
    *("__setitem__", "__delitem__", "__setattr__", "move_to_end", "difference_update", "intersection_update"),
    *("symmetric_difference_update", "partition", "setflags", "setfield", "write"),
}
_CHANGING_FUNCTIONS = {"setattr", "delattr", "heappush", "heappop", "heappushpop", "heapreplace", "heapify", "insort"}
_CHANGING_FUNCTIONS |= {"insort_left", "insort_right", "shuffle", "copyto", "put_along_axis", "place", "putmask"}


class Writes(NamedTuple):
    """Names that a function may change.

    Attributes
    ----------
    variables : frozenset of str
        Globals and closure variables that it assigns.
    attributes : frozenset of tuple (str, str)
        Attributes that it assigns, or whose items it changes: the variable in front of the first dot, and the name of
        the attribute.
    containers : frozenset of str
        Variables whose items it changes.
    arguments : frozenset of tuple (str, str, str)
        Names of the functions that it calls, and what it passes to them: a variable and the name of its attribute,
        empty for the variable itself.
    changes_arguments : bool
        Whether it may change the items of its own arguments.
    """

    variables: frozenset[str]
    attributes: frozenset[tuple[str, str]]
    containers: frozenset[str]
    arguments: frozenset[tuple[str, str, str]]
    changes_arguments: bool


@functools.lru_cache(maxsize=4096)
def writes_of(code: types.CodeType) -> Writes:
    """What a function may change.

    Parameters
    ----------
    code : code
        Of the function.
    """
    name = code.co_name
    variables = {step.argval for step in _steps(code) if step.opname in ("STORE_GLOBAL", "DELETE_GLOBAL")}
    free = {step.argval for step in _steps(code) if step.opname in ("STORE_DEREF", "DELETE_DEREF")}
    variables |= free & set(code.co_freevars)
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(code)))
        function = next(node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name == name)
    except (OSError, TypeError, SyntaxError, StopIteration, IndexError):
        return _from_names(code, name, frozenset(variables))
    reader = _Reader(function, set(code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]))
    reader.visit(function)
    return Writes(
        frozenset(variables),
        frozenset(reader.attributes),
        frozenset(reader.containers),
        frozenset(reader.arguments),
        reader.changes_arguments,
    )


def _from_names(code: types.CodeType, name: str, variables: frozenset[str]) -> Writes:
    """The same without a source text: all names of a function that changes a container."""
    attributes = {step.argval for step in _steps(code) if step.opname in ("STORE_ATTR", "DELETE_ATTR")}
    names = {item for part in _codes(code) for item in part.co_names}
    changes = any(step.opname in ("STORE_SUBSCR", "DELETE_SUBSCR", "STORE_SLICE") for step in _steps(code))
    containers: set[str] = set()
    if changes or names & (_CHANGING_METHODS | _CHANGING_FUNCTIONS):
        containers = names | set(code.co_freevars)
        attributes |= names
    if name in _CONSTRUCTORS:
        attributes = set()
    pairs = frozenset(("", attribute) for attribute in attributes)
    return Writes(variables, pairs, frozenset(containers), frozenset(), bool(containers))


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """A code object and those of the functions defined in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _codes(constant)


def _steps(code: types.CodeType) -> Iterator[dis.Instruction]:
    for part in _codes(code):
        yield from dis.get_instructions(part)


class _Reader(ast.NodeVisitor):
    """Collects the attributes and containers that the source text of a function changes."""

    def __init__(self, function: ast.FunctionDef, parameters: set[str]) -> None:
        self.attributes: set[tuple[str, str]] = set()
        self.containers: set[str] = set()
        self.arguments: set[tuple[str, str, str]] = set()
        self.changes_arguments = False
        self._parameters = parameters
        arguments = [*function.args.posonlyargs, *function.args.args]
        self._constructed = arguments[0].arg if function.name in _CONSTRUCTORS and arguments else None
        # other names of the same objects: table = self.table
        self._same = {
            target.id: node.value
            for node in ast.walk(function)
            if isinstance(node, ast.Assign | ast.AnnAssign | ast.NamedExpr) and node.value is not None
            for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
            if isinstance(target, ast.Name)
        }

    def _place(self, node: ast.expr, depth: int = 0) -> tuple[str, str] | None:
        """Variable and last attribute of an expression such as ``self.tables[3].rows``; None for a new object."""
        while isinstance(node, ast.Subscript | ast.Starred):
            node = node.value
        if isinstance(node, ast.Attribute):
            owner = self._place(node.value, depth)
            return (owner[0] if owner else "", node.attr)
        if isinstance(node, ast.Name):
            same = self._same.get(node.id)
            if same is not None and depth < 5 and isinstance(same, ast.Name | ast.Attribute | ast.Subscript):
                return self._place(same, depth + 1)
            return None if same is not None and node.id not in self._parameters else (node.id, "")
        if isinstance(node, ast.Call):  # type(self).count += 1, self.get().append(...)
            places = map(
                self._place, [*node.args, *([node.func.value] if isinstance(node.func, ast.Attribute) else [])]
            )
            return next(filter(None, places), None)
        return None

    def _changed(self, node: ast.expr) -> None:
        place = self._place(node)
        if place is None:
            return
        variable, attribute = place
        if attribute:
            if variable != self._constructed:
                self.attributes.add(place)
        elif variable in self._parameters:
            self.changes_arguments = True
        else:
            self.containers.add(variable)

    def _assigned(self, target: ast.expr) -> None:
        if isinstance(target, ast.Tuple | ast.List):
            for item in target.elts:
                self._assigned(item)
        elif isinstance(target, ast.Starred):
            self._assigned(target.value)
        elif isinstance(target, ast.Subscript):
            self._changed(target.value)
        elif isinstance(target, ast.Attribute):
            self._changed(target)

    def visit_Assign(self, node: ast.Assign) -> None:
        for target in node.targets:
            self._assigned(target)
        self.generic_visit(node)

    def visit_Delete(self, node: ast.Delete) -> None:
        for target in node.targets:
            self._assigned(target)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._changed(node.target)  # also of a variable: an array is changed in place
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self._assigned(node.target)
        self.generic_visit(node)

    def visit_For(self, node: ast.For) -> None:
        self._assigned(node.target)
        self.generic_visit(node)

    def visit_withitem(self, node: ast.withitem) -> None:
        if node.optional_vars is not None:
            self._assigned(node.optional_vars)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        function, name = node.func, ""
        if isinstance(function, ast.Attribute):
            name = function.attr
            if name in _CHANGING_METHODS:
                self._changed(function.value)
        elif isinstance(function, ast.Name):
            name = function.id
        if name == "setattr" and len(node.args) > 1 and isinstance(node.args[1], ast.Constant):
            self._changed(ast.Attribute(node.args[0], str(node.args[1].value)))
        elif name in _CHANGING_FUNCTIONS:
            for argument in node.args[:1]:
                self._changed(argument)
        for keyword in node.keywords:
            if keyword.arg == "out":
                self._changed(keyword.value)
        for argument in [*node.args, *(keyword.value for keyword in node.keywords)]:
            place = self._place(argument) if isinstance(argument, ast.Name | ast.Attribute | ast.Subscript) else None
            if place is not None and name:
                self.arguments.add((name, *place))
        self.generic_visit(node)
