"""Turning what pydantic reports into one line that an operator can act on.

Loaded where something is wrong, and only there.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from companion.errors import Problem
from companion.wording import show_value

# Tables that were read once, and what to write instead.
_GONE = {
    "valve_tracking": "valves are no longer tracked in flight: delete the table, and measure each "
    "valve with `vrspray calibrate valves`"
}
BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")

WRONG = {
    "float_type": "not a number",
    "float_parsing": "not a number",
    "int_type": "not a whole number",
    "int_from_float": "not a whole number",
    "bool_type": "not true or false",
    "string_type": "not text in quotes",
    "string_pattern_mismatch": "not in the right form",
    "string_too_short": "empty",
    "string_too_long": "too long",
    "literal_error": "not known",
    "enum": "not known",
    "greater_than": "out of range",
    "greater_than_equal": "out of range",
    "less_than": "out of range",
    "less_than_equal": "out of range",
    "finite_number": "not finite",
    "too_short": "too few entries",
    "too_long": "too many entries",
    "tuple_type": "not a list",
    "model_type": "not a table",
    "missing": "missing",
}


def say(errors: Sequence[ErrorDetails], raw: dict[str, Any], model: type[BaseModel]) -> str:
    """Return one line on the first error: key, value, what is wrong, what to write instead.

    An unknown key comes before a missing one: the typing error explains the gap.
    """
    return one_line(findings(errors, raw, model))


class Found(NamedTuple):
    """One thing that is wrong: the key, its value as text, what is wrong, what to write."""

    key: str
    value: str | None
    code: str
    wrong: str
    fix: str

    def line(self) -> str:
        """Return it as one piece of text."""
        value = "" if self.value is None else f" = {self.value}"
        return f"{self.key}{value}: {self.wrong}" + (f"; {self.fix}" if self.fix else "")

    def problem(self) -> Problem:
        """Return it as `config check` lists it."""
        got = "" if self.value is None else f": {self.value}"
        text = self.wrong if self.code == "contradiction" else f"{self.wrong}{got}"
        if self.code == "unknown-key":  # its value is not what is wrong
            text = f"{self.wrong}: {self.key}"
        return Problem(severity="error", code=self.code, text=text, where=self.key, fix=self.fix)


def one_line(found: Sequence[Found]) -> str:
    """Return the first finding, and how many more there are."""
    others = len(found) - 1
    more = "" if others == 0 else f" (and {others} more problem{'s' if others > 1 else ''})"
    return found[0].line() + more


def findings(
    errors: Sequence[ErrorDetails], raw: dict[str, Any], model: type[BaseModel]
) -> list[Found]:
    """Return all that is wrong, one finding a key, unknown keys first."""
    schema = _schema_of(model)
    ordered = sorted(errors, key=lambda error: error["type"] != "extra_forbidden")
    found: dict[tuple[str, str], Found] = {}
    for error in ordered:
        for each in _of_error(error, raw, schema):
            # Every branch of a union complains; two rules may complain of one key.
            rule = each.wrong if each.code == "contradiction" else ""
            found.setdefault((each.key, rule), each)
    return list(found.values())


@cache
def _schema_of(model: type[BaseModel]) -> dict[str, Any]:
    # Worked out anew it takes a fifth of a second, which a campaign or a page would pay each time.
    return model.model_json_schema(by_alias=True)


def _of_error(error: ErrorDetails, raw: dict[str, Any], schema: dict[str, Any]) -> Iterator[Found]:
    steps, value = _locate(error["loc"], raw)
    key = dotted(steps)
    if error["type"] == "contradiction":
        for inner, text in error["ctx"]["all"]:
            key = dotted(steps) + "." + inner if steps else inner
            value = _lookup(raw, key)
            shown = None if value is None else show_value(value)
            wrong, _, fix = text.partition("; ")
            yield Found(key, shown, "contradiction", wrong, fix)
        return
    if error["type"] == "extra_forbidden":
        yield Found(key, show_value(value), "unknown-key", "unknown key", _nearest(steps, schema))
        return
    node = _schema_at(steps, schema)
    allowed = f"write {allowed_text(node, schema, str(steps[-1]))}"
    if node.get("description"):
        meaning = node["description"].splitlines()[0]
        allowed += f" ({meaning})"
    wrong = WRONG.get(error["type"], error["msg"])
    if error["type"] == "missing":
        yield Found(key, None, "missing", "missing", allowed)
    else:
        yield Found(key, show_value(value), "wrong-value", wrong, allowed)


def dotted(steps: Sequence[str | int]) -> str:
    """Return a key as a person writes it.

    >>> dotted(("valve", 2, "right_m"))
    'valve[2].right_m'
    """
    text = ""
    for step in steps:
        if isinstance(step, int):
            text += f"[{step}]"
            continue
        name = step if BARE_KEY.fullmatch(step) else show_value(step)
        text += f".{name}" if text else name
    return text


def _locate(loc: Sequence[str | int], raw: Any) -> tuple[list[str | int], Any]:
    """Return the steps of `loc` that are keys of the file, and the value there.

    Behind the key of a union pydantic names the branch; that is no key.
    """
    steps: list[str | int] = []
    node = raw
    for step in loc:
        if not isinstance(node, dict | list):
            break
        steps.append(step)
        if isinstance(node, dict):
            node = node.get(str(step))
        else:
            node = node[step] if isinstance(step, int) and step < len(node) else None
    return steps, node


def _lookup(raw: Any, key: str) -> Any:
    """Return the value of a dotted key in the file; None where it is not in it."""
    steps = [int(s) if s.isdigit() else s for s in re.findall(r"[^.\[\]]+", key)]
    return _locate(steps, raw)[1]


def _resolved(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """Return a node of the schema without references and without its null branch."""
    if "$ref" in node:
        target = schema["$defs"][node["$ref"].rpartition("/")[2]]
        return {**target, **{key: value for key, value in node.items() if key != "$ref"}}
    branches = [branch for branch in node.get("anyOf", []) if branch.get("type") != "null"]
    if len(branches) == 1:
        rest = {key: value for key, value in node.items() if key != "anyOf"}
        return {**_resolved(branches[0], schema), **rest}
    return node


def _schema_at(steps: Sequence[str | int], schema: dict[str, Any]) -> dict[str, Any]:
    node = schema
    for step in steps:
        child = node.get("items", {}) if isinstance(step, int) else None
        if child is None:
            child = node.get("properties", {}).get(step) or node.get("additionalProperties") or {}
        elif "prefixItems" in node and isinstance(step, int) and step < len(node["prefixItems"]):
            child = node["prefixItems"][step]
        node = _resolved(child, schema)
    return node


def _nearest(steps: Sequence[str | int], schema: dict[str, Any]) -> str:
    if steps[-1] in _GONE:
        return _GONE[str(steps[-1])]
    known = list(_schema_at(steps[:-1], schema).get("properties", {}))
    near = difflib.get_close_matches(str(steps[-1]), known, n=1, cutoff=0.5)
    if near:
        return f"did you mean {dotted([*steps[:-1], near[0]])}?"
    table = dotted(steps[:-1])
    return f"{f'[{table}]' if table else 'the file'} can have: {', '.join(known)}"


def allowed_text(node: dict[str, Any], schema: dict[str, Any], name: str = "key") -> str:
    """Return in words what a key of the schema may be."""
    node = _resolved(node, schema)
    if "anyOf" in node:
        # TOML has no null: None is what a key is that is not written.
        branches = [branch for branch in node["anyOf"] if branch.get("type") != "null"]
        return " or ".join(allowed_text(branch, schema, name) for branch in branches)
    if "const" in node:
        return show_value(node["const"])
    if "enum" in node:
        return "one of " + ", ".join(show_value(value) for value in node["enum"])
    kind = str(node.get("type"))
    if kind == "array":
        return _list_text(node, schema, name)
    if kind in ("number", "integer"):
        return _number_text(node)
    texts = {"string": "text in quotes", "boolean": "true or false", "object": f"a table [{name}]"}
    return texts.get(kind, "another value")


def _number_text(node: dict[str, Any]) -> str:
    low = node.get("minimum")
    if low is not None and low == node.get("maximum"):
        return show_value(low)
    return ("a whole number" if node["type"] == "integer" else "a number") + _range(node)


def _list_text(node: dict[str, Any], schema: dict[str, Any], name: str) -> str:
    if "prefixItems" in node:
        return "[" + ", ".join(allowed_text(i, schema) for i in node["prefixItems"]) + "]"
    items = _resolved(node.get("items", {}), schema)
    if items.get("type") == "object":
        return f"[[{name}]] tables"
    least = f"at least {node['minItems']} " if node.get("minItems", 0) > 1 else ""
    text = allowed_text(items, schema).removeprefix("a ").replace("number", "numbers", 1)
    return f"a list of {least}{text}"


def _range(node: dict[str, Any]) -> str:
    low, high = node.get("minimum"), node.get("maximum")
    above, below = node.get("exclusiveMinimum"), node.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f" from {low:g} to {high:g}"
    lower = (
        f" above {above:g}" if above is not None else f" from {low:g}" if low is not None else ""
    )
    upper = (
        f" up to {high:g}" if high is not None else f" below {below:g}" if below is not None else ""
    )
    return lower + upper
