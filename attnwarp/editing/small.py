"""The editors that ship with the package: small, trained from nothing by eval/training/, read from
weights/.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp.errors import InputError, suggest

if TYPE_CHECKING:
    from attnwarp.editing.pix2pix import InstructPix2Pix

WEIGHTS = Path(__file__).parent / "weights"

TEXT_GUIDANCE, IMAGE_GUIDANCE = 1.5, 1.0
"""At higher text guidance a few colours take most answers, and colours saturate."""


def bundled(folder: Path = WEIGHTS) -> list[str]:
    """Names of the editors that are there."""
    return sorted(path.parent.name for path in folder.glob("*/model_index.json"))


def load_editor(name_or_folder: str, **settings: Any) -> InstructPix2Pix:
    """An editor by its name, such as "small-plain", or from a folder in diffusers' format.

    Args:
        name_or_folder: a bundled editor's name, or a path.
        settings: as in :meth:`attnwarp.editing.pix2pix.InstructPix2Pix.from_folder`.

    Raises:
        InputError: no such editor or folder, or files that are missing, by name.
    """
    from attnwarp.editing.folder import require_diffusers

    require_diffusers()

    from attnwarp.editing.pix2pix import InstructPix2Pix

    names = bundled()
    if name_or_folder in names:
        guidance = {"text_guidance": TEXT_GUIDANCE, "image_guidance": IMAGE_GUIDANCE}
        return InstructPix2Pix.from_folder(WEIGHTS / name_or_folder, **{**guidance, **settings})
    folder = Path(name_or_folder).expanduser()
    if not folder.is_dir():
        raise InputError(
            f"editor {name_or_folder!r}: neither bundled ({', '.join(names) or 'none is'}) nor a"
            f" folder{suggest(name_or_folder, names)}"
        )
    return InstructPix2Pix.from_folder(folder, **settings)
