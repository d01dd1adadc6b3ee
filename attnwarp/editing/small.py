"""Bundled editors: small, trained from scratch by eval/training/, read from weights/."""

from __future__ import annotations

import hashlib
import json
import re
import unicodedata
import warnings
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp.devices import on_cpu_unless_named, type_of, with_gradients
from attnwarp.errors import InputError, InputWarning, suggest
from attnwarp.process import core_count

if TYPE_CHECKING:
    import torch

    from attnwarp.editing.editor import Editor, Guide

WEIGHTS = Path(__file__).parent / "weights"

SUMS = "sha256.json"
"""File in a bundled editor's folder with the SHA-256 of its other files."""

ONE_THREAD_PARAMETERS = 50_000_000
"""Parameters below which a measured UNet runs on one thread: two give the bundled UNets, of 3
million, other bits."""

TEXT_GUIDANCE, IMAGE_GUIDANCE = 1.5, 1.0
"""Guidance weights of bundled editors. Higher text guidance favours a few colours, and
colours saturate.
"""

DEPTH_GUIDANCE = 2.0
"""Guidance weight of a bundled editor guided by depth; ControlNet's usual 5 to 7.5 saturates its
colours.
"""


def bundled() -> list[str]:
    """List the names of the bundled editors.

    Example:
        >>> bundled()
        ['small-depth', 'small-parts', 'small-plain']
    """
    return sorted(path.parent.name for path in WEIGHTS.glob("*/model_index.json"))


def say_foreign(name: str) -> str:
    """Write a sentence on what a bundled editor is not made for; empty for another editor."""
    if name not in bundled():
        return ""
    return (
        f"{name} was trained on drawn worlds, so photographs are not its world: its edits of them"
        " show how the method works, not how well"
    )


def check_sums(folder: Path) -> None:
    """Check the files of a bundled editor against their recorded SHA-256."""
    for name, expected in json.loads((folder / SUMS).read_text()).items():
        path = folder / name
        if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != expected:
            raise InputError(
                f"{path}: is missing or damaged: its SHA-256 is not the one in {SUMS}; install the"
                " package again"
            )


def thread_count(editor: Any) -> int:
    """Number of torch threads for a measured editor: one for a small UNet, so that figures depend
    on no machine's cores, and all cores for a large one.

    Example:
        >>> thread_count(load_editor("small-plain"))
        1
    """
    small = sum(p.numel() for p in editor.network.parameters()) < ONE_THREAD_PARAMETERS
    return 1 if small else core_count()


LOOKS = {
    *("red", "scarlet", "crimson", "orange", "yellow", "green", "blue", "purple", "violet"),
    *("pink", "brown", "black", "white", "grey", "gray", "shiny", "gold", "golden", "silver"),
    *("bronze", "copper", "chrome", "steel", "wood", "wooden", "stone", "marble", "striped"),
    *("checked", "chequered", "checkered", "pattern", "color", "material", "grass", "garden"),
    *("lawn", "park", "meadow", "sand", "beach", "desert", "snow", "snowy", "winter", "floor"),
    *("boards", "tile", "tiles", "tiled", "road", "asphalt", "earth", "bare", "soil", "clearing"),
    *("forest", "ground", "somewhere", "day", "daylight", "sun", "sunny", "sunset"),
    *("evening", "dusk", "warm", "night", "moon", "moonlit", "moonlight", "cloudy", "overcast"),
    *("time", "light", "sky", "colour", "statue", "something", "else", "another", "other"),
    *("different", "new"),
}
"""Words by which training instructions ask for a colour, a material, a pattern, a ground or a time
of day, one or any. Other words name objects or join.
"""


JOINING = {
    *("a", "an", "the", "it", "its", "this", "that", "these", "those", "all", "some", "my", "our"),
    *("and", "or", "of", "to", "into", "in", "on", "at", "by", "for", "from", "with", "as", "like"),
    *("is", "are", "be", "has", "have", "so", "please", "make", "turn", "give", "more", "very"),
    *("each", "every", "part", "parts"),
}
"""Words that join an instruction's others, so they are never named as unknown."""

ENDINGS = ("", "s", "es", "d", "ed", "y", "n", "en", "e", "ing")
"""Endings by which forms of one word differ."""


def forms(word: str) -> set[str]:
    """List forms that a word may have: "stripes" is a form of "striped".

    Example:
        >>> {"striped", "stripe"} <= forms("stripes"), "wood" in forms("wooden")
        (True, True)
    """
    stems = {word.removesuffix(ending) for ending in ENDINGS}
    return {stem + ending for stem in stems if len(stem) > 2 for ending in ENDINGS}


def check_words(name: str, text: str, *, anyway: bool = False) -> None:
    """Refuse, before loading, an instruction that an editor would ignore; warn of words that a
    bundled editor was not trained on.

    Args:
        anyway: True accepts an instruction without a word of :data:`LOOKS`, as for an editor
            guided by depth, whose text describes the edited scene.
    """
    if not text.strip():
        raise InputError("instruction: is empty, expected words such as 'make it red'")
    if name not in bundled():
        return
    card = f"{WEIGHTS / name / 'card.md'} says what it can do"
    words = {word.lower() for word in _words(text)}
    unknown = [word for word in unknown_words(name, text) if word.lower() not in JOINING]
    known = {word: sorted(forms(word.lower()) & _tokens(name) & LOOKS) for word in unknown}
    named = [f"{w!r}" + f" (it knows {', '.join(known[w])})" * bool(known[w]) for w in unknown]
    if not (anyway or words & LOOKS or guide_of(name) == "depth"):
        say = "".join(f"; it knows {', '.join(k)} for {w!r}" for w, k in known.items() if k)
        raise InputError(
            f"instruction: {text!r} names no color, material, pattern, ground or time of day that"
            f" the editor {name!r} knows, so it would do nothing of it{say}; {card}, --anyway tries"
        )
    if unknown:
        warnings.warn(
            f"instruction: the editor {name!r} was not trained on {', '.join(named)},"
            f" so the result may have nothing to do with it; {card}",
            InputWarning,
            stacklevel=2,
        )


def unknown_words(name: str, text: str) -> list[str]:
    """Words that a bundled editor was not trained on: its tokenizer has a token for each training
    word and splits other words."""
    return [word for word in _words(text) if word.lower() not in _tokens(name)]


@cache
def _tokens(name: str) -> set[str]:
    """List the tokens of a bundled editor that begin a word."""
    file = WEIGHTS / name / "tokenizer" / "tokenizer.json"
    tokens = json.loads(file.read_text(encoding="utf-8"))["model"]["vocab"]
    return {token[1:] for token in tokens if token[0] == "Ġ"}


def _words(text: str) -> list[str]:
    """List the distinct words of a text."""
    return [*dict.fromkeys(re.findall(r"[^\W\d_]+", unicodedata.normalize("NFKC", text)))]


def guide_of(name_or_folder: str) -> Guide:
    """Determine the guide of an editor without loading it."""
    folder, control = folders_of(name_or_folder)
    if control is not None:
        return "depth"
    guide: Guide = "picture" if name_or_folder in bundled() else kind_of(folder).guide
    return guide


def own_steps_of(name_or_folder: str) -> int:
    """Find an editor's own number of steps without loading it."""
    from attnwarp.editing.folder import index_of

    steps: int = _kind_named(name_or_folder).steps_of(index_of(folders_of(name_or_folder)[0]))
    return steps


def dtype_of(name: str, device: str, name_or_folder: str) -> torch.dtype:
    """Resolve the precision of an editor's networks: see :func:`attnwarp.devices.type_of`.

    Args:
        name: name of the precision; "auto" is on a GPU the half precision that the editor stands.
    """
    return type_of(name, device, _kind_named(name_or_folder).half)


def _kind_named(name_or_folder: str) -> Any:
    from attnwarp.editing.editor import Defaults

    folder, control = folders_of(name_or_folder)
    plain = control is not None or name_or_folder in bundled()
    return Defaults if plain else kind_of(folder)


def kind_of(folder: Path) -> Any:
    """Find the editor class of a folder by the pipeline in its model_index.json;
    InstructPix2Pix if the file names none.

    Raises:
        InputError: no editor reads the pipeline.
    """
    from attnwarp.editing.editors import kinds
    from attnwarp.editing.folder import pipeline_of

    known, named = kinds(), pipeline_of(folder)
    # A UNet's folder may belong to any Stable Diffusion pipeline.
    if named is None or (named not in known and (folder / "unet").is_dir()):
        named = "StableDiffusionInstructPix2PixPipeline"
    if named not in known:
        raise InputError(
            f"{folder}: is of the pipeline {named!r}, which no editor reads; expected one of"
            f" {', '.join(sorted(known))}"
        )
    return known[named]


def folders_of(name_or_folder: str) -> tuple[Path, Path | None]:
    """Find the folders of an editor and of its ControlNet (None for a picture-guided editor).

    Example:
        >>> [folder.name for folder in folders_of("small-depth")]
        ['small-depth', 'controlnet']
    """
    names = bundled()
    folder = Path(name_or_folder).expanduser()
    if name_or_folder in names:
        folder = WEIGHTS / name_or_folder
    elif "," in name_or_folder and not folder.is_dir():
        return _pair(name_or_folder)
    elif not folder.is_dir():
        raise InputError(
            f"editor {name_or_folder!r}: neither bundled ({', '.join(names) or 'none is'}) nor a"
            f" folder{suggest(name_or_folder, names)}"
        )
    own = folder / "controlnet"
    return folder, own if own.is_dir() else None


def _pair(folders: str) -> tuple[Path, Path]:
    """Split ``BASE,CONTROLNET`` into its two folders."""
    parts = [part.strip() for part in folders.split(",")]
    if len(parts) != 2 or not all(parts):
        raise InputError(f"editor {folders!r}: expected two folders, BASE,CONTROLNET")
    places = [Path(part).expanduser() for part in parts]
    for part, place in zip(("BASE", "CONTROLNET"), places, strict=True):
        if not place.is_dir():
            raise InputError(f"editor {folders!r}: {part} {str(place)!r} is no folder")
    return places[0], places[1]


@on_cpu_unless_named
@with_gradients
def load_editor(name_or_folder: str, **settings: Any) -> Editor:
    """Load an editor by name, such as "small-plain", or from folders in diffusers' format.

    A folder with a subfolder ``controlnet``, or a pair of folders, gives a
    :class:`~attnwarp.editing.editors.controlnet.DepthControlNet`.

    Args:
        name_or_folder: name of a bundled editor, a path, or "BASE,CONTROLNET", the paths of a
            Stable Diffusion and of its ControlNet.
        settings: ``device``, ``dtype`` and the options of the editor's class, such as
            ``text_guidance``. ``draws=False`` removes from a bundled editor the part by which the
            noise's mean chooses an answer; ``low_memory=True`` calls
            :func:`attnwarp.editing.memory.save_memory`.

    Raises:
        InputError: the editor or folder does not exist, or files are missing (named).

    Example:
        >>> editor = load_editor("small-plain")
        >>> editor.guide, editor.branches
        ('picture', ('text', 'image'))
    """
    from attnwarp.editing.folder import require_diffusers

    require_diffusers()

    from attnwarp.editing.memory import save_memory

    folder, control = folders_of(name_or_folder)
    if name_or_folder in bundled():
        check_sums(folder)
        guidance = (
            {"text_guidance": TEXT_GUIDANCE, "image_guidance": IMAGE_GUIDANCE}
            if control is None
            else {"text_guidance": DEPTH_GUIDANCE}
        )
        settings = {**guidance, **settings}
    draws, low_memory = settings.pop("draws", True), settings.pop("low_memory", False)
    device = settings.get("device", "cpu")
    if low_memory:
        settings["device"] = "cpu"
    editor: Editor
    if control is not None:
        from attnwarp.editing.editors.controlnet import DepthControlNet

        editor = DepthControlNet.from_folder(folder, control, **settings)
    else:
        editor = kind_of(folder).from_folder(folder, **settings)
    if not draws:
        if not getattr(editor, "draws", False):
            raise InputError(f"draws: the editor {name_or_folder!r} has no draw; leave it out")
        editor.network.draw = None
    if low_memory:
        save_memory(editor, device)
    return editor
