"""YAML reader that refuses duplicate keys and invalid values, with their line."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

import yaml
from yaml.composer import Composer

DEEPEST = 100
"""Levels of lists and keys within each other, within Python's stack; a scene has 8."""

TOO_DEEP = f"nested deeper than {DEEPEST} levels, or in itself; write it flat"


class YamlError(ValueError):
    """Text that is not usable YAML, with the line (from 1) if known."""

    def __init__(self, message: str, line: int | None = None) -> None:
        self.line = line
        super().__init__(message)


class _Loader(yaml.SafeLoader):
    """PyYAML's parser. A number is decimal, as in YAML 1.2: YAML 1.1 reads ``030`` as 24,
    ``1:30`` as 90, ``no`` as false and ``1e3`` as text.
    """

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012


TAG = "tag:yaml.org,2002:"

for _kind, _pattern, _first in (
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", "-+.0123456789"),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", "-+."),
    ("bool", "true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", "~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("merge", "<<", "<"),
):
    _Loader.add_implicit_resolver(TAG + _kind, re.compile(f"^(?:{_pattern})$"), list(_first))

if yaml.__with_libyaml__:

    class _Quick(Composer, yaml.CSafeLoader):
        """libyaml's parser, four times as fast, with PyYAML's composer, which no depth aborts."""

        yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers

        def __init__(self, text: str) -> None:
            yaml.CSafeLoader.__init__(self, text)
            Composer.__init__(self)


def _root(text: str) -> yaml.Node | None:
    """The root of a text, the same on every machine: texts that libyaml refuses, and tabs, which it
    takes for spaces, are parsed by PyYAML.
    """
    if yaml.__with_libyaml__ and "\t" not in text:
        with suppress(yaml.YAMLError, UnicodeError):
            return yaml.compose(text, Loader=_Quick)
    return yaml.compose(text, Loader=_Loader)


SCALARS: dict[str, Callable[[str], Any]] = {
    "str": str,
    "int": int,
    "float": lambda text: float(text.lower().replace(".inf", "inf").replace(".nan", "nan")),
    "bool": lambda text: {"true": True, "false": False}[text.lower()],
    "null": lambda text: None,
}


Place = tuple[int | str, ...]
"""Keys and indices that lead to a value; () is the whole file."""

Line = TypeVar("Line")


def read_yaml(text: str) -> tuple[dict[Place, int], Any]:
    """Parse a YAML text into the line (from 1) of every key path, and the value.

    Numbers are decimal: ``030`` is 30. Other notations of numbers, such as ``0x1e`` or ``1:30``,
    are words; so are dates, and ``yes``, ``no``, ``on`` and ``off``. Every key is a word.

    Raises:
        YamlError: the text is empty, not YAML or too deep; a key is duplicate or not a word; or a
            value does not match its tag.

    Example:
        >>> lines, data = read_yaml("fov: 045\\nsize: [3e2, 0256]")
        >>> data, lines["size", 1]
        ({'fov': 45, 'size': [300.0, 256]}, 2)
    """
    try:
        root = _root(text)
        if root is None:
            raise YamlError("the file is empty")
        reading = _Reading()
        reading.lines[()] = root.start_mark.line + 1
        return reading.lines, reading.value(root, ())
    except YamlError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise YamlError(
            f"not valid YAML: {_line(error.problem or error)}; check indentation and quotes"
            f"{_bare_color(text)}",
            mark.line + 1 if mark else None,
        ) from error
    except RecursionError:
        raise YamlError(TOO_DEEP) from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # an escape such as \\UFFFFFFFF
        raise YamlError(f"not valid YAML: {_line(error)}") from error


class _Reading:
    """Reading of nodes as values; an alias is read at each occurrence."""

    def __init__(self) -> None:
        self.lines: dict[Place, int] = {}

    def value(self, node: yaml.Node, place: Place) -> Any:
        line = node.start_mark.line + 1
        if len(place) > DEEPEST:
            raise YamlError(TOO_DEEP, line)
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, place)
        if isinstance(node, yaml.SequenceNode):
            for i, item in enumerate(node.value):
                self.lines[*place, i] = item.start_mark.line + 1
            return [self.value(item, (*place, i)) for i, item in enumerate(node.value)]
        kind = node.tag.removeprefix(TAG)
        if kind not in SCALARS:
            raise YamlError(f"the tag {node.tag!r} means nothing here; leave it out", line)
        try:
            return SCALARS[kind](node.value)
        except (ValueError, LookupError) as error:
            raise YamlError(f"{node.value[:40]!a} is no {kind}", line) from error

    def _mapping(self, node: yaml.MappingNode, place: Place) -> dict[str, Any]:
        own: dict[str, int] = {}
        data: dict[str, Any] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if not isinstance(key, yaml.ScalarNode):
                raise YamlError("a key is a list or a mapping, expected a word", line)
            if key.value in own:  # in YAML the last one wins
                raise YamlError(
                    f"the key {key.value!r} stands here and on line {own[key.value]}; keep one",
                    line,
                )
            own[key.value] = line
        # Merged keys come first, so that explicit keys win.
        for key, item in sorted(node.value, key=lambda entry: entry[0].tag != TAG + "merge"):
            if key.tag == TAG + "merge":
                several = isinstance(item, yaml.SequenceNode)
                for one in reversed(item.value) if several else [item]:
                    value = self.value(one, place)
                    if not isinstance(value, dict):
                        raise YamlError("<<: expected keys with values", own[key.value])
                    data |= value
            else:
                self.lines[*place, key.value] = own[key.value]
                data[key.value] = self.value(item, (*place, key.value))
        return data


BARE_COLOR = re.compile(
    r"""^(?:[^#'"]|'[^']*'|"[^"]*")*?(?:[:,]\s+|\[\s*|^\s*-\s+)#[0-9a-fA-F]{6}\b"""
)
"""Pattern of a colour that YAML takes for a comment."""


def _bare_color(text: str) -> str:
    """End of an error's message if the text has a colour without quotes; else empty."""
    for number, line in enumerate(text.splitlines(), 1):
        if BARE_COLOR.search(line):
            return f"; line {number} has a colour without quotes, which YAML takes for a comment"
    return ""


def line_of(lines: dict[Place, Line], loc: Sequence[int | str]) -> Line:
    """Line (from 1) of the deepest key path of ``loc``, whose tags of unions are skipped."""
    place: Place = ()
    for step in loc:
        if (*place, step) in lines:
            place = (*place, step)
    return lines[place]


def _line(error: object) -> str:
    return " ".join(str(error).split())
