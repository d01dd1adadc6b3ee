"""Hook of mkdocs: the README as home page, and a page of reference for each public module.

Links from a page to a file outside docs/ are checked and shown as the file's name, since the site
has no place for it.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "attnwarp": ROOT / "attnwarp",
    "attnwarp_eval": ROOT / "eval" / "attnwarp_eval",
    "attnwarp_lab": ROOT / "eval" / "attnwarp_lab",
}
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def public_modules() -> list[str]:
    """Dotted names of the modules that have a docstring and a public function or class.

    A module whose name, or whose package's name, begins with an underscore is private.
    """
    names = []
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            parts = [package, *path.relative_to(folder).with_suffix("").parts]
            if parts[-1] == "__init__":
                parts.pop()
            if any(part.startswith("_") for part in parts):
                continue
            tree = ast.parse(path.read_text(encoding="utf-8"))
            public = any(
                isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
                for node in tree.body
            )
            if ast.get_docstring(tree) and public:
                names.append(".".join(parts))
    return names


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that have no file in docs/."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=readme))
    listing = ["# Reference", ""]
    for name in public_modules():
        files.append(File.generated(config, f"api/{name}.md", content=f"# {name}\n\n::: {name}\n"))
        listing.append(f"- [{name}]({name}.md)")
    files.append(File.generated(config, "api/index.md", content="\n".join(listing) + "\n"))
    return files


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Append the reference to the navigation of mkdocs.yml."""
    modules = public_modules()
    packages = [
        {package: [f"api/{name}.md" for name in modules if name.split(".")[0] == package]}
        for package in PACKAGES
    ]
    config.nav = [*(config.nav or []), {"Reference": ["api/index.md", *packages]}]
    return config


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace links that leave docs/ by the name of the file, which must exist."""

    def outside(match: re.Match[str]) -> str:
        text, target = match[1], match[2]
        if "://" in target or files.get_file_from_path(target) is not None:
            return match[0]
        home = page.file.src_uri == "index.md"
        path = ((ROOT if home else (ROOT / "docs" / page.file.src_uri).parent) / target).resolve()
        if path.is_relative_to(ROOT / "docs"):
            return match[0]  # of the site: mkdocs itself checks it
        if not path.exists():
            raise PluginError(f"{page.file.src_uri}: links to {target}, which does not exist")
        name = path.relative_to(ROOT).as_posix()
        return text if name in text else f"{text} (`{name}`)"

    return LINK.sub(outside, markdown)
