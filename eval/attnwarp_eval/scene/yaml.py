"""YAML from people: one reader that refuses what is doubled, endless or no value, with its line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import yaml

LONGEST = 2**20
"""Characters of a file. The largest scene that comes along has 20,000."""

DEEPEST = 40
"""Levels of lists and keys within each other; a scene has 8."""

MOST_VALUES = 100_000
"""Values of a file, each counted as often as aliases repeat it."""


class YamlError(ValueError):
    """Text that is no usable YAML, with its line (from 1) where there is one."""

    def __init__(self, message: str, line: int | None = None) -> None:
        self.line = line
        super().__init__(message)


def read_yaml(text: str) -> tuple[yaml.Node, Any]:
    """The nodes of a YAML text, for line numbers, and what they mean.

    Raises:
        YamlError: the text is empty or no YAML; a key stands twice or is no word; a value is no
            date or number although it is written as one; or the text is too long, too deep, or
            repeats itself by aliases too often.

    Example:
        >>> root, data = read_yaml("size: [2, 3]")
        >>> data
        {'size': [2, 3]}
    """
    if len(text) > LONGEST:
        raise YamlError(f"has {len(text):,} characters, more than {LONGEST:,}")
    if FAST is not None and not DISPUTED.intersection(text):
        try:
            return _read(text, FAST)
        except YamlError:
            pass  # It may be usable all the same, and messages are those of PyYAML's own parser.
    return _read(text, EXACT)


def _read(text: str, loader: type[Any]) -> tuple[yaml.Node, Any]:
    try:
        _limit(text, loader)
        reading = loader(text)
        try:
            root = reading.get_single_node()
            if root is None:
                raise YamlError("the file is empty")
            _check_keys(root)
            data = reading.construct_document(root)
        finally:
            reading.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise YamlError(
            f"not valid YAML: {_line(error.problem or error)}; check indentation and quotes"
            f"{_bare_color(text)}",
            mark.line + 1 if mark else None,
        ) from error
    except yaml.YAMLError as error:
        raise YamlError(f"not valid YAML: {_line(error)}") from error
    return root, data


BARE_COLOR = re.compile(
    r"""^(?:[^#'"]|'[^']*'|"[^"]*")*?(?:[:,]\s+|\[\s*|^\s*-\s+)#[0-9a-fA-F]{6}\b"""
)
"""A colour that YAML takes for a comment."""


def _bare_color(text: str) -> str:
    """What to add to an error where the text has a colour without quotes."""
    for number, line in enumerate(text.splitlines(), 1):
        if BARE_COLOR.search(line):
            return f"; line {number} has a colour without quotes, which YAML takes for a comment"
    return ""


def line_of(node: yaml.Node, loc: Sequence[int | str]) -> int:
    """Line (from 1) of the deepest node that ``loc`` leads to; the tags that unions put into a loc
    lead nowhere.
    """
    line = node.start_mark.line + 1
    for step in loc:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                if key.value == step:
                    line, node = key.start_mark.line + 1, value
                    break
        elif (
            isinstance(node, yaml.SequenceNode) and isinstance(step, int) and step < len(node.value)
        ):
            node = node.value[step]
            line = node.start_mark.line + 1
    return line


def _line(error: object) -> str:
    return " ".join(str(error).split())


class _Values(yaml.constructor.SafeConstructor):
    """PyYAML's safe conversions, which raise whatever Python raises."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (
            ValueError, TypeError, LookupError, AttributeError, OverflowError,
        ) as error:  # fmt: skip
            if isinstance(error, YamlError):
                raise
            kind = node.tag.removeprefix("tag:yaml.org,2002:")
            written = ascii(node.value[:40]) if isinstance(node, yaml.ScalarNode) else "this"
            raise YamlError(f"{written} is no {kind}", node.start_mark.line + 1) from error


class _Exact(_Values, yaml.SafeLoader):
    """All in Python."""


EXACT: type[Any] = _Exact
FAST: type[Any] | None = None
"""libyaml's parser where PyYAML has it: 15 times as fast."""

DISPUTED = frozenset("\t!\ufeff")
"""Characters that libyaml and PyYAML's own parser read otherwise in places: ``title: !``, a tab
after a colon, a byte order mark on a later line."""

if yaml.__with_libyaml__:

    class _Fast(_Values, yaml.CSafeLoader):
        """The parser in C."""

    FAST = _Fast


def _limit(text: str, loader: type[Any]) -> None:
    """Refuse depth and repetition before anything is built, since both end a program."""
    sizes: dict[str, int] = {}
    open_: list[tuple[str | None, int]] = []  # anchor and size so far of what is not closed yet
    total = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            line = event.start_mark.line + 1
            size = 0
            match event:
                case yaml.AliasEvent():
                    if any(anchor == event.anchor for anchor, _ in open_):
                        raise YamlError(f"*{event.anchor} stands for what it is part of", line)
                    size = sizes.get(event.anchor, 1)
                case yaml.ScalarEvent():
                    size = 1
                    if event.anchor:
                        sizes[event.anchor] = size
                case yaml.SequenceStartEvent() | yaml.MappingStartEvent():
                    open_.append((event.anchor, 1))
                    if len(open_) > DEEPEST:
                        raise YamlError(f"nested deeper than {DEEPEST} levels", line)
                case yaml.SequenceEndEvent() | yaml.MappingEndEvent():
                    anchor, size = open_.pop()
                    if anchor:
                        sizes[anchor] = size
            if open_:
                open_[-1] = (open_[-1][0], open_[-1][1] + size)
            total = max(total, size, *(inner for _, inner in open_)) if open_ else max(total, size)
            if total > MOST_VALUES:
                raise YamlError(f"means more than {MOST_VALUES:,} values, aliases included", line)
    except (ValueError, OverflowError) as error:  # an escape such as \\UFFFFFFFF
        if isinstance(error, YamlError):
            raise
        raise YamlError(f"not valid YAML: {_line(error)}") from error


def _check_keys(node: yaml.Node, checked: set[int] | None = None) -> None:
    """YAML itself lets the last of two equal keys win, silently."""
    checked = set() if checked is None else checked
    if id(node) in checked:
        return
    checked.add(id(node))
    if isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            line = key.start_mark.line + 1
            if not isinstance(key, yaml.ScalarNode):
                raise YamlError("a key is a list or a mapping, expected a word", line)
            if key.value in lines:
                raise YamlError(
                    f"the key {key.value!r} stands here and on line {lines[key.value]}; keep one",
                    line,
                )
            lines[key.value] = line
            _check_keys(value, checked)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_keys(item, checked)
