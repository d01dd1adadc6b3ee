"""Model cards: data, abilities and limits of each bundled encoder, and the figures
behind that.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from attnwarp.encoders._weights import sha256_of

ABOUT = {
    "clip-small": """Pictures and English sentences in one space of {dim} dimensions: a convolutional tower of {vision:.1f} million
parameters for pictures of 112 x 112 px, of which each is embedded as the mean with its mirror image, a transformer of {text:.1f} million for
text, byte-pair tokens.

**Good for**: scores of renders and edits of scenes like those in `scenes/`: one thing on a ground, its colour, its material or pattern,
the ground, the time of day; whether an edit went in the direction of the words; comparisons between methods on the same views.

**Not good for**: photographs of the world, people's identity, style ("as Van Gogh would paint it"), counting, left and right, anything
outside its words. It knows {objects} things, {colors} colours, {finishes} surfaces, {grounds} grounds and {times} times of day (`attnwarp_eval/drawn/worlds.py`). A word
that it does not know is read in pieces and mostly passed over: "a robot dinosaur" is a dinosaur to it. Its figures do not
compare with those of OpenAI's CLIP, whose name stands beside a figure when it was used (`--clip clip:FOLDER`).
On edits whose truth is known similarity to the prompt prefers blurred results and is blind to small shifts (docs/measuring/metrics.md).

**Recipe**: `training/encoders/naming.py`, then `training/encoders/clip.py`. First {warm_epochs} epochs in which linear heads name each attribute from the image
tower's features; three in ten pictures have their colours scrambled, and of these the thing alone is asked. Then contrast over batches of 128 pictures and 256
sentences, half of which have one attribute wrong; looks of one world, which differ in little, lie in one batch; sentences that happen to be
true of another picture are no negatives. Beside it contrast with the words for one attribute at a time, and the heads, which are left behind.
Rare words and invented ones are scattered into captions so that unknown words do little harm.""",
    "clip-parts": """clip-small, trained further on things with parts: pictures and English sentences in one space of {dim} dimensions, and
a vector for each place of 8 x 8 px. From the two follows with which probability words are true of a place.

**Good for**: masks by words (docs/method/editing-a-scene.md); scores of scenes that show things with parts: people in garments, plants in pots, busts,
tables laid. There it names the thing and tells edits of parts apart more often than clip-small.

**Not good for**: what clip-small is not good for; and things of one piece, which it names less often than clip-small (the card of that one has
the same questions). It knows clip-small's words and {part_words} parts of {kinds} things (`attnwarp_eval/drawn/assemblies.py`). Scenes with much more detail than
its worlds are outside of what it learned: reports/editor/segments.md has the overlap of its masks there.

**Recipe**: `training/encoders/clip_parts.py`, on clip-small's weights as they are published, in half precision. Sentences about parts by contrast, half of
them with one thing wrong; which surface a part has; and for each place which of all words are true of it, by the focal loss. Rays know the part
that every pixel shows. A share of the pictures of things of one piece is shown too, so that little is forgotten.""",
    "dino-small": """A class token and 8 x 8 patch tokens of {dim} dimensions from pictures of 128 x 128 px: convolutions to a sixteenth of the
size, then three transformer blocks; {size:.1f} million parameters.

**Good for**: whether two pictures show the same thing, from whichever side.

**Not good for**: telling photographs of the world apart, fine differences within a kind, and correspondences: its patch tokens find parts hardly better
than those of a network with random weights (below), and warps are checked against rays (`checks/`), not against these tokens. Its figures do not compare with those of DINOv2 (`--dino dinov2:FOLDER`).

**Recipe**: `training/encoders/dino.py`. Self-distillation with multi-crop and a momentum teacher, whose targets are centred and sharpened by Sinkhorn's normalisation; no labels. The two large crops are two
views of one thing, which at times stands on another ground or in another light. Patches of small crops are taught by the teacher's patches
at the same place. Beside it a thing's two views are told
from the batch's other things.""",
    "perceptual-small": """A distance of two pictures of one size, any size: differences of normalised features at four scales, weighted by channel
and averaged, as LPIPS, plus the difference of the pictures themselves averaged over 4 x 4 px; {size:.2f} million parameters. Its square root times 5 is
about the strength of a distortion on the scale of `training/encoders/distort.py`: 1 is faint, 5 ruined.

**Good for**: putting degradations of a picture in order (blur, noise, compression, tone, small shifts), which PSNR and SSIM confuse; above all
small shifts, which look like nothing and cost PSNR much.

**Not good for**: standing in for people's judgement: the order of strengths is known, not asked of anyone, and between kinds of distortion it is
our own scale. Different contents: it has no opinion on which of two other objects is nearer. Its figures do not compare with those of LPIPS (`--perceptual
lpips:FILE`).

**Recipe**: `training/encoders/perceptual.py`. Features and weights learned together from pairs of distortions of which one is the stronger, on crops of
photographs that scikit-image ships and of rendered worlds.""",
}

DATA = """**Data**: pictures of random worlds, {pictures} (`attnwarp_eval/drawn/worlds.py`, `attnwarp_eval/drawn/objects.py`){more}, with captions that are
true of them by construction; {photos}nothing was downloaded. Never seen in training: every shape of the tests, one in ten pairs of object and colour,
every world of the tests. One exception: dinosaurs with plates come in one shape."""


def card(
    name: str,
    figures: Sequence[dict[str, Any]],
    control: Sequence[dict[str, Any]],
    facts: dict[str, Any],
    files: Sequence[Path],
) -> str:
    """A card in Markdown.

    Args:
        figures: figures of the trained network (:class:`training.assess.figures.Figure` as
            dictionaries).
        control: the same of a network with random weights.
    """
    lines = [f"# {name}", "", ABOUT[name].format(**facts), "", DATA.format(**facts), ""]
    lines += [
        "## Figures on what it has never seen", "",
        "Share of right answers with its 95 % interval (bootstrap over worlds); random weights: the same network untrained.", "",
        "| question | trained | random weights | chance | asked for | answers |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    untrained = {f["what"]: f for f in control}
    for f in figures:
        other = untrained.get(f["what"])
        same = other is None or other["value"] == f["value"]
        lines.append(
            f"| {f['what']} | **{100 * f['value']:.1f} %** ({100 * f['low']:.1f} to {100 * f['high']:.1f}) "
            f"| {'' if same or other is None else format(100 * other['value'], '.1f') + ' %'} "
            f"| {'' if f['chance'] is None else format(100 * f['chance'], '.1f') + ' %'} "
            f"| {'' if f['asked'] is None else format(100 * f['asked'], '.0f') + ' %'} | {f['count']} |"
        )
    missed = [f["what"] for f in figures if f["asked"] is not None and f["value"] < f["asked"]]
    if missed:
        lines += ["", "Short of what was asked for: " + "; ".join(missed) + "."]
    trained = "" if facts.get("minutes") is None else f", trained in {facts['minutes']:.0f} minutes"
    lines += ["", "## Files", "", "| file | bytes | SHA-256 |", "|---|---|---|"]
    for path in files:
        lines.append(
            f"| `{path.name}` | {path.stat().st_size} | `{hashlib.sha256(path.read_bytes()).hexdigest()}` |"
        )
    if len(files) > 1:
        lines += [
            "",
            f"SHA-256 of all, one after the other, by which results name the encoder: `{sha256_of(files)}`.",
        ]
    lines += [
        "",
        f"32 pictures of 128 x 128 px take {facts['seconds']:.2f} s on {facts['threads']} thread(s) of the machine that made "
        f"this card. Made with torch {facts['torch']}, {facts['epochs']} epochs, seed {facts['seed']}{trained}.",
        "",
    ]
    return "\n".join(lines)
