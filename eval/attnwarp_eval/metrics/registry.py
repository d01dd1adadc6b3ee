"""Definition of every metric: its unit, its direction, and how closely two runs of it must agree.

Nothing heavy is imported here, so that reports and comparisons can read it without the checks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Direction = Literal["higher", "lower", "zero", "none"]


@dataclass(frozen=True)
class Metric:
    """The specification of one figure.

    Attributes:
        name: ``check.figure``, such as ``warp.epe_median``. A result's key may carry further parts behind it: a region
            (``depth.bias.edge``) or a feature size (``warp.epe_median.64``).
        unit: "px" (of the image), "layer px", "scene" (scene units), "deg", "dB", "dE00" (CIEDE2000), "share" (of 1),
            "ratio", "cosine" (of embeddings, -1 to 1), "decades" (of 10), "own" (the unit of a hard case's tolerance),
            "rows" (through a network), "pixels", "views" or "points" (counts).
        direction: which values are better; "zero" for signed figures that are best at 0, "none" for counts that
            describe.
        atol, rtol: a change of at most ``atol + rtol * |value|`` between two runs is no change.
        description: one line for a reader of a report.
        version: raised when the figure's numbers change meaning.
        column: head of a column in the table of the probe that measures it, and of its row in ``attnwarp-eval
            metrics``; without it, the metric is only in tables that name it.
        pictures: folders of ``attnwarp-eval metrics`` that it is computed from, of "renders", "edited", "originals".
        function: function that computes it from a view's pictures, (H, W, 3) sRGB in [0, 1] in the
            order of ``pictures``, such as "attnwarp_eval.metrics.image:psnr".
        squared: whether it is the mean squared error behind a PSNR; its means are shown in decibels.
    """

    name: str
    unit: str
    direction: Direction
    atol: float
    rtol: float
    description: str
    version: int = 1
    column: str = ""
    pictures: tuple[str, ...] = ()
    function: str = ""
    squared: bool = False

    @property
    def is_count(self) -> bool:
        """True if it only describes how much was measured, and is no figure of quality."""
        return self.unit in ("pixels", "views", "points") and self.direction == "none"


    @property
    def scale(self) -> Literal["ratio", "share", "plain"]:
        """Scale on which two variants are compared: errors above 0 and costs as ratios, shares as shares.

        Example:
            >>> [METRICS[name].scale for name in ("warp.epe_median", "occlusion.recall", "fit.psnr")]
            ['ratio', 'share', 'plain']
        """
        if self.unit == "share":
            return "share"
        ratios = ("px", "layer px", "scene", "deg", "ratio", "rows")
        return "ratio" if self.direction == "lower" and self.unit in ratios else "plain"


class Registry(dict[str, Metric]):
    """Metrics by name; also accepts a result's key, with a region or size after the name."""

    def __missing__(self, key: str) -> Metric:
        name = ".".join(key.split(".")[:2])
        if name == key or name not in self:
            raise KeyError(key)
        return self[name]


_SPECS = (
    Metric("calibration.mitsuba_agrees", "share", "higher", 1e-3, 0, "pixels whose point Mitsuba finds as the ray caster"),
    Metric("warp.epe_median", "px", "lower", 1e-4, 1e-3, "median endpoint error, visible pixels"),
    Metric("warp.epe_p95", "px", "lower", 1e-3, 1e-2, "95th percentile of the endpoint error, visible pixels"),
    Metric("warp.epe_mean", "px", "lower", 1e-3, 1e-2, "mean endpoint error, visible pixels"),
    Metric("warp.epe_median_layer", "layer px", "lower", 1e-4, 1e-3, "median endpoint error on the feature grid"),
    Metric("warp.epe_p95_layer", "layer px", "lower", 1e-3, 1e-2, "95th percentile of it on the feature grid"),
    Metric("warp.below_half_px", "share", "higher", 1e-4, 0, "visible pixels warped to within 0.5 px"),
    Metric("warp.below_1px", "share", "higher", 1e-4, 0, "visible pixels warped to within 1 px"),
    Metric("warp.below_2px", "share", "higher", 1e-4, 0, "visible pixels warped to within 2 px"),
    Metric("warp.coverage", "share", "higher", 1e-4, 0, "visible pixels that have a position"),
    Metric("warp.visible", "pixels", "none", 0, 0, "pixels that the source truly shows"),
    Metric("warp.feature_accepted", "ratio", "lower", 1e-4, 1e-3, "relative feature error, accepted visible pixels"),
    Metric("warp.feature_visible", "ratio", "lower", 1e-4, 1e-3, "relative feature error, all visible pixels"),
    Metric("warp.feature_all_accepted", "ratio", "lower", 1e-4, 1e-3, "relative feature error, all accepted"),
    Metric("warp.feature_pixels", "pixels", "none", 0, 0, "accepted visible feature pixels"),
    Metric("occlusion.precision", "share", "higher", 1e-4, 0, "of what the mask accepts, truly visible"),
    Metric("occlusion.recall", "share", "higher", 1e-4, 0, "of what is truly visible, accepted"),
    Metric("occlusion.f1", "share", "higher", 1e-4, 0, "harmonic mean of precision and recall"),
    Metric("occlusion.false_positive_rate", "share", "lower", 1e-4, 0, "of surface not visible, accepted"),
    Metric("occlusion.false_negative_rate", "share", "lower", 1e-4, 0, "of what is truly visible, rejected"),
    Metric("occlusion.behind_share", "share", "lower", 1e-4, 0, "of what the mask accepts, behind the source camera"),
    Metric("occlusion.hidden_share", "share", "lower", 1e-4, 0, "of what the mask accepts, hidden from the source"),
    Metric("occlusion.visible_accepted", "pixels", "none", 0, 0, "visible pixels accepted"),
    Metric("occlusion.visible_rejected", "pixels", "none", 0, 0, "visible pixels rejected"),
    Metric("occlusion.hidden_accepted", "pixels", "none", 0, 0, "hidden pixels accepted"),
    Metric("occlusion.hidden_rejected", "pixels", "none", 0, 0, "hidden pixels rejected"),
    Metric("occlusion.outside_accepted", "pixels", "none", 0, 0, "pixels accepted whose point is not in the source"),
    Metric("occlusion.outside_rejected", "pixels", "none", 0, 0, "pixels rejected whose point is not in the source"),
    Metric("occlusion.behind_accepted", "pixels", "none", 0, 0, "pixels behind the source camera accepted"),
    Metric("occlusion.behind_rejected", "pixels", "none", 0, 0, "pixels behind the source camera rejected"),
    Metric("occlusion.empty_accepted", "pixels", "none", 0, 0, "pixels without a surface accepted"),
    Metric("occlusion.ambiguous_accepted", "pixels", "none", 0, 0, "ambiguous pixels accepted, not scored"),
    Metric("occlusion.ambiguous_rejected", "pixels", "none", 0, 0, "ambiguous pixels rejected, not scored"),
    Metric("fit.psnr", "dB", "higher", 1e-2, 1e-3, "PSNR of a view held out from the fit"),
    Metric("fit.mse", "ratio", "lower", 1e-6, 1e-2, "mean squared error of a view held out from the fit", squared=True),
    Metric("fit.ssim", "ratio", "higher", 1e-4, 1e-3, "SSIM of a view held out from the fit (11 x 11, sigma 1.5)"),
    Metric("depth.abs_rel", "ratio", "lower", 1e-5, 1e-2, "mean of |z - z*| / z*"),
    Metric("depth.rmse", "scene", "lower", 1e-5, 1e-2, "root mean square of z - z*"),
    Metric("depth.bias", "scene", "zero", 1e-5, 1e-2, "mean of z - z*; negative is toward the camera"),
    Metric("depth.bias_relative", "ratio", "zero", 1e-5, 1e-2, "mean of (z - z*) / z*; negative is toward the camera"),
    Metric("depth.bias_median", "ratio", "zero", 1e-5, 1e-2, "median of (z - z*) / z*; negative is toward the camera"),
    Metric("depth.delta_1_01", "share", "higher", 1e-4, 0, "pixels with max(z / z*, z* / z) < 1.01"),
    Metric("depth.delta_1_25", "share", "higher", 1e-4, 0, "pixels with max(z / z*, z* / z) < 1.25"),
    Metric("depth.normal_mean", "deg", "lower", 1e-2, 1e-2, "mean angle to the true normal"),
    Metric("depth.normal_median", "deg", "lower", 1e-2, 1e-2, "median angle to the true normal"),
    Metric("depth.coverage", "share", "higher", 1e-4, 0, "pixels with a surface that have a depth"),
    Metric("depth.pixels", "pixels", "none", 0, 0, "pixels with a surface"),
    Metric("depth.phantom", "pixels", "none", 0, 0, "pixels with a depth and no surface"),
    # Float32 networks on other processors agree to 1e-6; the rest of atol is for pictures that differ by rounding.
    Metric("embedding.clip_similarity", "cosine", "higher", 1e-3, 0, "CLIP: render against the target prompt"),
    Metric("embedding.clip_directional", "cosine", "higher", 2e-3, 0, "CLIP: change of the view against the prompt's"),
    Metric("embedding.clip_image", "cosine", "higher", 1e-3, 0, "CLIP: render against the edited source view"),
    Metric("embedding.dino_image", "cosine", "higher", 1e-3, 0, "DINO: render against the edited source view"),
    Metric("embedding.direction_consistency", "cosine", "higher", 2e-3, 0, "changes of neighbouring views against each other"),
    Metric("embedding.clip_neighbours", "cosine", "higher", 1e-3, 0, "CLIP: neighbouring edited views against each other"),
    Metric("embedding.match_similarity", "cosine", "higher", 1e-3, 0, "patches after the edit that matched before it"),
    Metric("embedding.undefined", "views", "lower", 0, 0, "views whose embedding or change has no direction"),
    # A counter of a cell's cost, not of a view.
    Metric("cost.network_rows", "rows", "lower", 0, 0, "rows through the editor's network, inversions included"),
    Metric("perceptual.distance", "ratio", "lower", 1e-4, 1e-2, "perceptual distance of edited picture and render"),
    # Image metrics, consistency and fidelity: attnwarp_eval.metrics, docs/measuring/metrics.md.
    Metric("image.mse", "ratio", "lower", 1e-6, 1e-2, "mean squared error of sRGB values", squared=True),
    Metric("image.psnr", "dB", "higher", 1e-2, 1e-3, "PSNR of sRGB values; infinite for equal pictures"),
    Metric("image.mse_linear", "ratio", "lower", 1e-6, 1e-2, "mean squared error in linear light", squared=True),
    Metric("image.psnr_linear", "dB", "higher", 1e-2, 1e-3, "PSNR in linear light; infinite for equal pictures"),
    Metric("image.ssim", "ratio", "higher", 1e-4, 1e-3, "SSIM of sRGB values (11 x 11, sigma 1.5, whole windows)"),
    Metric("image.ms_ssim", "ratio", "higher", 1e-4, 1e-3, "MS-SSIM of sRGB values, five scales, from 176 px"),
    Metric("image.pixels", "pixels", "none", 0, 0, "pixels compared"),
    Metric("edit.psnr_pooled", "dB", "higher", 1e-2, 1e-3, "Edit PSNR: PSNR of the mean MSE over the views"),
    Metric("edit.psnr_mean", "dB", "higher", 1e-2, 1e-3, "Edit PSNR: mean of the views' finite PSNRs"),
    Metric("edit.psnr", "dB", "higher", 1e-2, 1e-3, "Edit PSNR of one view, whose name stands behind"),
    Metric("edit.mse", "ratio", "lower", 1e-6, 1e-2, "mean squared error of one view, whose name stands behind", squared=True),
    Metric("edit.views", "views", "none", 0, 0, "edited views that were compared"),
    Metric(
        "edit.drift", "px", "lower", 1e-2, 1e-2, "displacement of the corner that the edit moves most, by what it leaves alone",
        column="Drift of the edit", pictures=("originals", "edited"), function="attnwarp_eval.metrics.image:edit_drift",
    ),
    Metric("edit.views_identical", "views", "none", 0, 0, "of them, views whose pictures are equal (PSNR infinite)"),
    Metric("edit.views_undefined", "views", "none", 0, 0, "of them, views with nothing to measure"),
    *(
        metric
        for prefix, where in (
            ("", "at exact correspondences"),
            ("flow_", "along optical flow"),
            ("rendered_", "at correspondences of rendered depth"),
        )
        for metric in (
            Metric(f"consistency.{prefix}mae_srgb", "ratio", "lower", 1e-5, 1e-2, f"mean absolute sRGB difference of two views {where}: the reprojection loss"),
            Metric(f"consistency.{prefix}delta_e", "dE00", "lower", 1e-3, 1e-2, f"mean CIEDE2000 between two views {where}"),
            Metric(f"consistency.{prefix}pixels", "pixels", "none", 0, 0, f"pixels compared {where}"),
        )
    ),
    Metric("consistency.colmap_registered", "share", "higher", 1e-4, 0, "views that COLMAP's largest model has"),
    Metric("consistency.colmap_points", "points", "higher", 0, 5e-2, "its 3D points"),
    Metric("consistency.colmap_track_length", "views", "higher", 1e-2, 5e-2, "views that see a point, mean"),
    Metric("consistency.colmap_error", "px", "lower", 1e-3, 5e-2, "mean reprojection error of its points"),
    Metric("consistency.colmap_failed", "share", "lower", 1e-4, 0, "sets of views of which it makes no model"),
    Metric("consistency.edit_delta_e", "dE00", "lower", 1e-3, 1e-2, "mean CIEDE2000 of two views at known correspondences that the edit adds, changed pixels"),
    Metric("consistency.edit_delta_e_p90", "dE00", "lower", 1e-2, 1e-2, "90th percentile of it"),
    Metric("consistency.edit_pixels", "pixels", "none", 0, 0, "changed pixels that were compared"),
    Metric("consistency.features", "ratio", "lower", 1e-3, 0, "1 - cosine of the features of two views at known correspondences"),
    Metric("consistency.perceptual", "ratio", "lower", 1e-4, 1e-2, "perceptual distance of a view and the other warped to it, known correspondences"),
    Metric("multiview.delta_e", "dE00", "lower", 1e-3, 1e-2, "mean CIEDE2000 of two edited views at the same points"),
    Metric("multiview.delta_e_floor", "dE00", "none", 1e-3, 1e-2, "the same of the true edited views"),
    Metric("multiview.delta_e_above", "dE00", "lower", 1e-3, 1e-2, "disagreement above that floor; below 0, views are more alike than true ones"),
    Metric("multiview.share", "share", "none", 1e-4, 0, "share of the pixels asked about that was compared"),
    Metric("multiview.pixels", "pixels", "none", 0, 0, "pixels compared"),
    Metric("multiview.same_answer", "share", "higher", 1e-4, 0, "views whose nearest answer is the source's"),
    Metric("multiview.same_part", "share", "higher", 1e-4, 0, "parts with the source's colour, as bright as they were"),
    Metric("fidelity.mse", "ratio", "lower", 1e-6, 1e-2, "mean squared error against the truth of the edit", squared=True),
    Metric("fidelity.psnr", "dB", "higher", 1e-2, 1e-3, "PSNR against the truth of the edit"),
    Metric("fidelity.ssim", "ratio", "higher", 1e-4, 1e-3, "SSIM against the truth of the edit"),
    Metric("fidelity.ms_ssim", "ratio", "higher", 1e-4, 1e-3, "MS-SSIM against the truth of the edit"),
    Metric("fidelity.distance", "ratio", "lower", 1e-4, 1e-2, "perceptual distance to the truth of the edit"),
    Metric("fidelity.preserved_mse", "ratio", "lower", 1e-6, 1e-2, "MSE against the unedited picture, outside the object", squared=True),
    Metric("fidelity.preserved_psnr", "dB", "higher", 1e-2, 1e-3, "PSNR against the unedited picture, outside the object"),
    Metric("fidelity.preserved_ssim", "ratio", "higher", 1e-4, 1e-3, "SSIM against the unedited picture, outside the object"),
    Metric("fidelity.preserved_distance", "ratio", "lower", 1e-4, 1e-2, "distance to the unedited picture, outside the object"),
    Metric("fidelity.pixels", "pixels", "none", 0, 0, "pixels compared"),
    Metric("labels.net", "share", "higher", 1e-4, 0, "of tokens that the source truly shows, and hidden ones that take a part's label: right less wrong less painted, -1 to 1"),
    Metric("labels.right", "share", "higher", 1e-4, 0, "tokens that the source truly shows, and that take their own part's label"),
    Metric("labels.wrong", "share", "lower", 1e-4, 0, "of them, those that take another label"),
    Metric("labels.none", "share", "lower", 1e-4, 0, "of them, those that take nothing"),
    Metric("labels.painted_hidden", "share", "lower", 1e-4, 0, "tokens that the source does not show, and that take a part's label"),
    Metric("labels.painted_outside", "share", "lower", 1e-4, 0, "tokens outside the thing that take a part's label"),
    Metric("labels.visible", "pixels", "none", 0, 0, "tokens of the thing that the source truly shows"),
    Metric("labels.hidden", "pixels", "none", 0, 0, "tokens of the thing that it does not show"),
    Metric("labels.outside", "pixels", "none", 0, 0, "tokens outside the thing"),
    Metric("masks.iou", "share", "higher", 1e-4, 0, "intersection over union of a lifted mask and the exact one"),
    Metric("masks.precision", "share", "higher", 1e-4, 0, "of what a lifted mask marks, the thing"),
    Metric("masks.recall", "share", "higher", 1e-4, 0, "of the thing, marked by a lifted mask"),
    Metric("masks.given", "share", "higher", 1e-4, 0, "IoU of the source's mask, as it is before it is lifted, with the exact one"),
    Metric("masks.back", "share", "higher", 1e-4, 0, "IoU of that mask and of itself, lifted, in the source"),
    Metric("masks.union", "pixels", "none", 0, 0, "pixels of a lifted mask or of the thing"),
    Metric("masks.marked", "pixels", "none", 0, 0, "pixels of a lifted mask"),
    Metric("masks.thing", "pixels", "none", 0, 0, "pixels of the thing"),
    Metric("parts.seen", "share", "higher", 1e-4, 0, "parts truly seen by the source that show its answer"),
    Metric("parts.right", "share", "higher", 1e-4, 0, "pixels truly seen by the source that show its answer"),
    Metric("parts.through", "share", "lower", 1e-4, 0, "hidden pixels that show the answer of the surface before them"),
    Metric("parts.fill", "share", "higher", 1e-4, 0, "parts that the source does not show, with one answer in two targets"),
    Metric("parts.fill_pairs", "pixels", "none", 0, 0, "pairs of such a part with itself in another target"),
    Metric("parts.bleed", "dE00", "lower", 1e-3, 1e-2, "mean CIEDE2000 to the picture before, outside the thing"),
    Metric("parts.delta_e", "dE00", "lower", 1e-3, 1e-2, "mean CIEDE2000 to the source's answers, at pixels truly seen"),
    Metric("parts.seen_parts", "pixels", "none", 0, 0, "parts truly seen by the source"),
    Metric("parts.hidden_pixels", "pixels", "none", 0, 0, "hidden pixels with another part before them"),
    Metric("shape.same", "share", "higher", 1e-4, 0, "places that show the source's answer"),
    Metric("shape.new", "share", "higher", 1e-4, 0, "new surface that the source sees, and that stands there with its answer"),
    Metric("shape.uncovered", "share", "higher", 1e-4, 0, "uncovered surface that shows what the source's answer uncovers"),
    Metric("shape.overlap", "share", "higher", 1e-4, 0, "intersection over union of silhouettes of what is new"),
    Metric("shape.lost", "dE00", "lower", 1e-3, 1e-2, "mean CIEDE2000 to the truth on untouched surface"),
    Metric("shape.stands", "share", "higher", 1e-4, 0, "pixels whose depth of tuned splats is within 2 % of the scene after"),
    Metric("shape.depth", "ratio", "lower", 1e-4, 1e-3, "mean relative error of that depth"),
    # Hard cases: attnwarp_eval.stability, docs/measuring/hard-cases.md.
    Metric("stability.margin", "decades", "higher", 1e-2, 0, "log10 of tolerance over error, cut at 3 and -3"),
    Metric("stability.error", "own", "lower", 0, 1e-2, "error of a hard case, in the unit of its tolerance"),
    Metric("stability.refused", "share", "none", 0, 0, "1 where a hard input was refused with an error, else 0"),
)

METRICS = Registry({metric.name: metric for metric in _SPECS})
"""Every figure the checks give."""


def metric(key: str) -> Metric:
    """The specification behind a result's key. KeyError: no such metric.

    Example:
        >>> from attnwarp_eval import metrics
        >>> metrics.metric("warp.epe_median.64").unit
        'px'
    """
    return METRICS[key]


def at_size(figures: Mapping[str, float], size: int) -> dict[str, float]:
    """Name figures for a feature size: ``warp.epe_median`` becomes ``warp.epe_median.64``.

    Example:
        >>> from attnwarp_eval import metrics
        >>> metrics.at_size({"warp.epe_median": 0.5}, 64)
        {'warp.epe_median.64': 0.5}
    """
    return {f"{name}.{size}": value for name, value in figures.items()}
