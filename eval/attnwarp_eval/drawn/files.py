"""Drawn scenes as files, which every command reads like any other scene file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from attnwarp.errors import InputError
from attnwarp_eval.drawn.scenes import Drawn
from attnwarp_eval.files import write_atomic

HEAD = (
    "# Drawn by a generator, not made by hand; `attnwarp-eval scenes draw` writes the same file"
    " again.\n# What each key means: docs/truth/scenes.md\n"
)


def to_text(data: Mapping[str, Any]) -> str:
    """A scene as the text of a YAML file: an object a paragraph, an edit a paragraph.

    Example:
        >>> from attnwarp_eval.drawn.scenes import draw
        >>> from attnwarp_eval.scene.yaml import read_yaml
        >>> scene = draw(0, seed=7)
        >>> read_yaml(to_text(scene.data))[1] == scene.data
        True
    """
    return HEAD + "\n".join(_top(data)) + "\n"


def _top(data: Mapping[str, Any]) -> Iterator[str]:
    for key, value in data.items():
        if key in ("objects", "edits", "lights"):
            yield f"{key}:" if value else f"{key}: []"
            for item in value:
                yield from _item(item, nested=key != "lights")
        elif key == "cameras":
            yield f"{key}:"
            for name, part in value.items():
                if name == "targets":
                    yield "  targets:"
                    yield from (f"    - {_flow(view)}" for view in part)
                else:
                    yield f"  {name}: {_flow(part)}"
        else:
            yield f"{key}: {_flow(value)}"


def _item(item: Mapping[str, Any], *, nested: bool) -> Iterator[str]:
    if not nested:
        yield f"  - {_flow(item)}"
        return
    start = "  - "
    for name, part in item.items():
        if isinstance(part, list):
            yield f"{start}{name}:"
            yield from (f"      - {_flow(one)}" for one in part)
        else:
            yield f"{start}{name}: {_flow(part)}"
        start = "    "


def _flow(value: Any) -> str:
    """A value on one line."""
    text: str = yaml.dump(
        value, Dumper=_Dumper, default_flow_style=True, width=10**9, sort_keys=False
    )
    return text.removesuffix("...\n").strip()


class _Dumper(yaml.CSafeDumper if yaml.__with_libyaml__ else yaml.SafeDumper):  # type: ignore[misc]
    """YAML dumper without aliases: an alias would be one value in two places."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def write(scene: Drawn, folder: Path) -> Path:
    """Write a scene into a folder, as ``NAME.yaml`` with its meshes; each file appears complete.

    Raises:
        InputError: one of the files exists with other content; nothing is written.
    """
    path = folder / f"{scene.spec.name}.yaml"
    contents = {folder / name: source.read_bytes() for name, source in scene.files.items()}
    contents[path] = to_text(scene.data).encode()
    missing = [file for file in contents if not file.exists()]
    for file, content in contents.items():
        if file not in missing and file.read_bytes() != content:
            raise InputError(
                f"{file}: is not the file that would be drawn here, and would be lost; name another"
                " folder, or move it away"
            )
    for file in missing:
        write_atomic(file, contents[file], durable=False)
    return path
