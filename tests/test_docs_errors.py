"""The page of error messages: its quotes are in the package, and no message is missing from it."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.once

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "howto" / "errors.md"
ERRORS = ("InputError", "UnresistedMotion", "FactorizationError", "NotConverged")

# Messages with the field of a torn system, an array of a file, or an internal argument in front.
BY_THEIR_FIELD = (
    "feti/checks/system.py",
    "feti/files/system.py",
    "feti/files/arrays.py",
    "feti/solver.py",
)


@cache
def quotes() -> list[str]:
    """Return the messages that the page explains, without what stands for names and numbers."""
    terms = re.findall(r"^(`.*`)\n: ", PAGE.read_text(), re.MULTILINE)
    return [quote for term in terms for quote in re.findall(r"`([^`]+)`", term)]


def message(node: ast.expr) -> str:
    """Return the text of an expression, with … for what is filled in."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else "…"
    if isinstance(node, ast.JoinedStr):
        return "".join(message(part) for part in node.values)
    if isinstance(node, ast.BinOp):
        return message(node.left) + message(node.right)
    return "…"


def pattern(quote: str) -> re.Pattern[str]:
    """Return what finds a quote in a message; … stands for anything, or for nothing at an end."""
    parts = [re.escape(part) for part in quote.strip("… ").split("…")]
    return re.compile("[^\0]*".join(parts))


@cache
def texts() -> str:
    """Return all strings of the package, separated by zeros."""
    trees = [ast.parse(path.read_text()) for path in (ROOT / "fenics_tfeti").rglob("*.py")]
    strings = (ast.Constant, ast.JoinedStr, ast.BinOp)
    found = {message(n) for tree in trees for n in ast.walk(tree) if isinstance(n, strings)}
    return "\0".join(sorted(found))


def raised() -> list[tuple[str, str]]:
    """Return the messages of all errors that are raised with their text, with their files."""
    found = []
    for path in sorted((ROOT / "fenics_tfeti").rglob("*.py")):
        file = path.relative_to(ROOT / "fenics_tfeti").as_posix()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ERRORS:
                found += [(file, message(argument)) for argument in node.args[:1]]
    return [(file, text) for file, text in found if text.strip("…: ") != ""]


def test_quotes_are_messages_of_the_package():
    assert len(quotes()) > 100
    for quote in quotes():
        assert pattern(quote).search(texts()), quote


def test_no_message_is_missing():
    messages = raised()
    assert len(messages) > 150
    missing = [
        (file, text)
        for file, text in messages
        if "expected" not in text
        and not file.startswith(("qp/", *BY_THEIR_FIELD))
        and not any(pattern(quote).search(text) for quote in quotes())
    ]
    assert not missing, "\n".join(map(str, missing))


@pytest.mark.parametrize(
    ("quote", "text"), [("a … b", "is a cat, or b"), ("x of …", "x of 3"), ("x", "the x")]
)
def test_pattern(quote, text):
    assert pattern(quote).search(text)
    assert not pattern(quote).search("another")
