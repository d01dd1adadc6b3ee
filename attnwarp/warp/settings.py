"""Settings of a warp, and presets: the paper's text, its released code, the measured optimum, and
its variant for small pictures and fitted splats.
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
    """Choices of a warp and its mask on which papers and code differ.

    Each field can be varied alone with ``dataclasses.replace``; the defaults are the ``corrected``
    preset.

    Args:
        pixel_centers: "half" or "integer", see :func:`attnwarp.warp.correspondence.correspond`.
        bounds: image whose size bounds the positions. Positions lie in the source image, so
            "target" is only right if both images have one size.
        in_front: True requires the point in front of the source camera. Without this test, points
            behind the camera project through the centre.
        opaque: smallest alpha that counts as surface, in the target and, if its alpha is given, in
            the source; None only requires a defined depth.
        depth_agreement: True requires the point's depth in the source camera to equal the source's
            depth map.
        depth_relative, depth_slope: tolerance of depth agreement, ``depth_relative * z +
            depth_slope * slope``, the slope being the depth's change per pixel
            (:func:`attnwarp.warp.depth.depth_slope`).
        photometric: largest mean over channels of abs(warped source image - target image), sRGB in
            [0, 1], on the images before the edit; None disables the test.
        segment: True restricts the mask to the target's segment, if given.
        normal_test: test on the pixels' normals: "facing" keeps surface seen from the same side by
            source and target; "source_incidence" surface that the source sees within
            ``normal_angle`` of the normal; "camera_frame" reproduces the published code, which
            flips camera-space normals to each camera and compares them although the two frames
            differ.
        gaussian_filter: the same tests on Gaussians, before the target's depth is rendered, and
            "printed": the rule as printed in the paper, which drops Gaussians whose normals are
            within the angle.
        normal_angle: limit in degrees, for every test with an angle.
        depth: point where a ray meets a splat: "intersection" (the plane of a 2D splat, the
            density's peak along the ray for a 3D one) or "center" (the z of the splat's centre, as
            in gsplat).
        depth_statistic: "expected" or "median" depth along the ray.
        undefined_depth: value of pixels without rendered depth: "none", or the view's largest depth
            ("farthest").
        depth_interpolation: interpolation of depth at the centres of a feature grid, see
            :func:`attnwarp.warp.resize_depth`.
        depth_spread: relative difference above which taps are not blended; None blends across
            edges.
        mask_resize: resizing of the mask to a feature grid: "area" averages over each feature
            pixel, "bilinear" between the 4 mask pixels around its centre; above 0.5 counts.

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
"""Four presets.

``paper``: the text. The mask is "inside the image", with the target's size; no rule tests whether a
point lies in front of the source camera or is hidden from it. Gaussians whose normals differ by
more than 60 degrees are dropped before the target's depth is rendered; each normal is "as seen
from" its view, so in that camera's axes and flipped to it. Two sentences of the text and the
authors' code agree on this; the inequality is printed the other way round, "excluded if n_s . n_t
>= cos 60", which keeps nothing if source and target are one view (``gaussian_filter="printed"``).
``"facing"`` is the same in world axes. Choices left open by the text (pixel centres, resizing) are
set to their correct values, so that this preset fails only where the text does.

``released``: the authors' code. Integer pixel centres with align_corners=True on the LAYER's grid,
although the rasteriser samples at +0.5; no test of the sign of z; the source's size in the bounds
test; a photometric test of 0.2 on the unedited images and the target's segment in the mask;
camera-space normals, flipped to the camera and compared across two different camera frames, kept
within 60 degrees; depth of the splats' centres, replaced by the view's largest if undefined; the
mask built at image size and resized bilinearly, which reads 4 of its pixels.

``corrected``: the default, chosen by measurements against truth. Half-pixel centres; points inside
the source image, in front of its camera, opaque, in agreement with the source's depth, and on the
same side of the surface, tested on pixels: a filter on the Gaussians would open holes through which
the target's depth shows the far side. Depth by ray-splat intersection, its median along the ray,
interpolated at a feature grid in 1 / z without blending across edges. The mask's mean over each
feature pixel. The numbers (0.5, 1e-2, 0.05) are for rendered splats and come from the measurements
in reports/warp/choices.md; exact depth takes ``attnwarp.warp.rules.EXACT_DEPTH_TOLERANCE`` and
``attnwarp.warp.depth.TAP_SPREAD``.

``tolerant``: ``corrected`` for small pictures and fitted splats, whose depth is less accurate per
pixel. A surface may recede by a fifth from one tap to the next, and depths may differ by 2 %: more
features reach visible surface, and slightly more reach hidden surface (reports/rules/report.md).
"""


def preset(name: str, **changes: Any) -> WarpSettings:
    """Return a preset with some of its fields changed.

    Args:
        name: name of the preset, "paper", "released", "corrected" or "tolerant".
        changes: fields of :class:`WarpSettings`.

    Raises:
        ValueError: a preset or field is unknown, or a value is out of range; the message names it.

    Example:
        >>> from attnwarp.warp import preset
        >>> preset("corrected", opaque=0.9).opaque
        0.9
    """
    check.one_of(name, list(PRESETS), "preset")
    return PRESETS[name].changed(**changes)
