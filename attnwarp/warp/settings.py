"""The choices a warp is made of, and presets: the paper's text, its released code, what measures
right, and the same for small pictures and fitted splats.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from attnwarp import check
from attnwarp.errors import Named
from attnwarp.settings import Range, Settings, Share, Weight

PixelCenters = Literal["half", "integer"]
DepthInterpolation = Literal["inverse", "bilinear", "nearest"]
Bounds = Literal["source", "target"]
NormalTest = Literal["none", "facing", "camera_frame", "source_incidence"]
GaussianFilter = Literal["none", "printed", "facing", "camera_frame", "source_incidence"]
SplatDepth = Literal["intersection", "center"]
DepthStatistic = Literal["expected", "median"]
MaskResize = Literal["area", "bilinear", "nearest"]
UndefinedDepth = Literal["none", "farthest"]


@dataclass(frozen=True)
class WarpSettings(Settings):
    """Everything about a warp and its mask that papers and codes decide differently.

    Each field can be varied alone with ``dataclasses.replace``; the defaults are the ``corrected``
    preset.

    Args:
        pixel_centers: "half" or "integer", see :func:`attnwarp.warp.correspondence.correspond`.
        bounds: the image whose size the positions are held against. They lie in the source image,
            so "target" is only right where the two have one size.
        in_front: the point lies in front of the source camera. Without it, points behind project
            through the centre.
        opaque: smallest alpha that counts as surface, in the target and, where its alpha is given,
            in the source; None asks for a defined depth alone.
        depth_agreement: the point's depth in the source camera is the depth the source itself sees
            there.
        depth_relative, depth_slope: tolerance of that test, ``depth_relative * z + depth_slope *
            slope``, the slope being the depth's change per pixel
            (:func:`attnwarp.warp.depth.depth_slope`).
        photometric: largest mean over channels of abs(warped source image - target image), sRGB in
            [0, 1], on the images before the edit; None leaves the test out.
        segment: only pixels of the target's segment, where one is given.
        normal_test: test on the pixels' normals: "facing" keeps surface of which source and target
            see the same side; "source_incidence" what the source sees within ``normal_angle`` of
            the normal; "camera_frame" reproduces the published code, which flips camera-space
            normals to each camera and compares them although the two frames differ.
        gaussian_filter: the same tests on Gaussians, before the target's depth is rendered, and
            "printed": the paper's rule as its text has it, which drops those whose normals are
            within the angle.
        normal_angle: degrees, for every test that has an angle.
        depth: where a ray meets a splat: "intersection" (the plane of a 2D splat, the density's
            peak along the ray for a 3D one) or "center" (the z of the splat's centre, as in
            gsplat).
        depth_statistic: "expected" or "median" depth along the ray.
        undefined_depth: value where the render has no depth: "none", or the view's largest depth
            ("farthest").
        depth_interpolation: how depth reaches the centres of a feature grid, see
            :func:`attnwarp.warp.resize_depth`.
        depth_spread: taps that differ by more than this fraction are not blended; None blends
            across edges.
        mask_resize: how the mask reaches a feature grid: "area" means over each feature pixel,
            "bilinear" between the 4 mask pixels around its centre; above 0.5 counts.

    Raises:
        ValueError: an unknown choice or a number out of range; the message names the field.

    Example:
        >>> from dataclasses import replace
        >>> from attnwarp.warp import PRESETS, WarpSettings
        >>> settings = WarpSettings()
        >>> settings == PRESETS["corrected"]
        True
        >>> replace(settings, opaque=2.0)
        Traceback (most recent call last):
        ValueError: opaque: ...
    """

    pixel_centers: PixelCenters = "half"
    bounds: Bounds = "source"
    in_front: bool = True
    opaque: Share | None = 0.5
    depth_agreement: bool = True
    depth_relative: Weight = 1e-2
    depth_slope: Weight = 0.5
    photometric: Share | None = None
    segment: bool = False
    normal_test: NormalTest = "facing"
    gaussian_filter: GaussianFilter = "none"
    normal_angle: Annotated[float, Range(0, 180)] = 60.0
    depth: SplatDepth = "intersection"
    depth_statistic: DepthStatistic = "median"
    undefined_depth: UndefinedDepth = "none"
    depth_interpolation: DepthInterpolation = "inverse"
    depth_spread: Weight | None = 0.05
    mask_resize: MaskResize = "area"


PRESETS: Named[WarpSettings] = Named(
    paper=WarpSettings(
        bounds="target",
        in_front=False,
        opaque=None,
        depth_agreement=False,
        normal_test="none",
        gaussian_filter="camera_frame",
        depth_statistic="expected",
    ),
    released=WarpSettings(
        pixel_centers="integer",
        bounds="source",
        in_front=False,
        opaque=None,
        depth_agreement=False,
        photometric=0.2,
        segment=True,
        normal_test="none",
        gaussian_filter="camera_frame",
        depth="center",
        depth_statistic="expected",
        undefined_depth="farthest",
        depth_interpolation="bilinear",
        depth_spread=None,
        mask_resize="bilinear",
    ),
    corrected=WarpSettings(),
    tolerant=WarpSettings(depth_relative=2e-2, depth_spread=0.2),
)
"""Four sets of choices.

``paper``: the text. The mask is "inside the image", with the target's size; nothing asks whether a
point lies in front of the source camera or is hidden from it. Gaussians whose normals, each "as
seen from" its view, so in that camera's axes and flipped to it, are more than 60 degrees apart are
left out before the target's depth is rendered. That is what two sentences of the text and the
authors' code mean; the inequality is printed the other way round, "excluded if n_s . n_t >= cos
60", which keeps nothing where source and target are one view (``gaussian_filter="printed"``).
``"facing"`` is the same in world axes. What the text leaves open (pixel centres, resizing) is as it
has to be right, so that this preset fails only where the text does.

``released``: the authors' code. Integer pixel centres with align_corners=True on the LAYER's grid,
where the rasteriser samples at +0.5; no test of the sign of z; the source's size in the bounds
test; a photometric test of 0.2 on the unedited images and the target's segment in the mask;
camera-space normals, flipped to the camera and compared across two different camera frames, of
which pairs within 60 degrees are kept; depth of the splats' centres, and the view's largest where
there is none; the mask made at image size
and resized bilinearly, which looks at 4 of its pixels.

``corrected``: what measurement against truth says is right, and the default. Half-pixel centres;
inside the source image, in front of its camera, opaque, the point's depth agreeing with the
source's own, and the same side of the surface seen, tested on the pixels: a filter on the Gaussians
would open holes through which the target's depth shows the far side. Depth by ray-splat
intersection, its median along the ray, carried to a feature grid in 1 / z without blending across
edges. The mask's mean over each feature pixel. The numbers (0.5, 1e-2, 0.05) are for rendered
splats and come from the measurements in reports/warp/choices.md; exact depth takes
``attnwarp.warp.rules.EXACT_DEPTH_TOLERANCE`` and ``attnwarp.warp.depth.TAP_SPREAD``.

``tolerant``: ``corrected`` for small pictures and fitted splats, whose depth is less sure for its
pixels. A surface may recede by a fifth from one tap to the next, and depths may differ by 2 %: more
features reach what the source shows, and a little more is taken by what it does not
(reports/rules/report.md).
"""


def preset(name: str, **changes: Any) -> WarpSettings:
    """A preset, with some of its fields changed.

    Args:
        name: "paper", "released", "corrected" or "tolerant".
        changes: fields of :class:`WarpSettings`.

    Raises:
        ValueError: an unknown preset or field, or a value out of range; the message names it.

    Example:
        >>> from attnwarp.warp import preset
        >>> preset("corrected", opaque=0.9).opaque
        0.9
    """
    check.one_of(name, list(PRESETS), "preset")
    return PRESETS[name].changed(**changes)
