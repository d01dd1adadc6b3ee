"""A run's records as tables of numbers: variant x scene x view -> value, and results.jsonl."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from attnwarp_eval.files import canonical_json
from attnwarp_eval.metrics.occlusion import COUNTS
from attnwarp_eval.metrics.registry import metric as metric_of
from attnwarp_eval.study.parts import Splats, Variant
from attnwarp_eval.study.store import Store, StoreError


@dataclass
class Results:
    """The finished cells of a run.

    Attributes:
        study: the resolved study as plain JSON.
        cells: one entry an expected cell, with its record under "record" (None where it is not
            done).
        failures: the table of failed cells.
    """

    study: dict[str, Any]
    cells: list[dict[str, Any]]
    failures: list[dict[str, Any]]

    @classmethod
    def of(cls, store: Store) -> Results:
        """Read a run's folder."""
        kept = store.read_study()
        done = store.done()
        cells, failures = [], store.failures()
        for cell in kept["cells"]:
            record = None
            if cell["id"] in done:
                try:
                    record = store.read(cell["id"])
                except StoreError as error:
                    # One damaged file must not cost the report of the others.
                    labels = {
                        "scene": cell["scene"],
                        "variant": cell["variants"][0],
                        "probe": cell["probe"],
                    }
                    failures.append({**labels, "error": str(error)})
            cells.append({**cell, "record": record})
        return cls(kept["study"], cells, failures)

    @cached_property
    def _variants(self) -> dict[str, Variant]:
        return {name: Variant.model_validate(said) for name, said in self.study["variants"].items()}

    def variant_like(self, said: Mapping[str, Any], probe: str) -> str | None:
        """The name of the measured variant that means what ``said`` means, written as a study
        writes a variant.
        """
        wanted = Variant.model_validate(dict(said))
        for name, variant in self._variants.items():
            same = variant.settings() == wanted.settings() and variant.geometry == wanted.geometry
            # Splats are sampled or fitted; each probe knows one of the two.
            same &= (
                variant.fit == wanted.fit
                if probe == "fit"
                else self._splats(variant) == self._splats(wanted)
            )
            if same and self.records(probe, name):
                return name
        return None

    def _splats(self, variant: Variant) -> Splats:
        return Splats.model_validate({**self.study["splats"], **variant.splats})

    @property
    def layer(self) -> int:
        """The feature grid that tables show: an eighth of the image, as in a diffusion UNet, or the
        next there is.
        """
        size, sizes = self.study["size"], self.study["feature_sizes"]
        return (
            size // 8
            if size // 8 in sizes
            else max((s for s in sizes if s < size), default=max(sizes))
        )

    @property
    def measured(self) -> int:
        """How many of the expected cells are done."""
        return sum(c["record"] is not None for c in self.cells)

    def records(self, probe: str, variant: str) -> list[tuple[str, int, dict[str, Any]]]:
        """(scene, seed, record) of the finished cells of a variant, in the study's order."""
        return [
            (c["scene"], c["seed"], c["record"])
            for c in self.cells
            if c["probe"] == probe and variant in c["variants"] and c["record"] is not None
        ]

    def views(
        self, probe: str, variant: str, metric: str, yaw: tuple[float, float] | None = None
    ) -> dict[str, dict[str, float]]:
        """Scene -> view (and seed) -> value; NaN where undefined.

        Args:
            yaw: keep the views whose yaw from the source lies in this closed range of degrees.
        """
        table: dict[str, dict[str, float]] = {}
        for scene, seed, record in self.records(probe, variant):
            for view in record["views"]:
                if yaw is not None and not yaw[0] <= view["yaw"] <= yaw[1]:
                    continue
                value = view["metrics"].get(metric)
                table.setdefault(scene, {})[f"{view['view']}/{seed}"] = (
                    math.nan if value is None else float(value)
                )
        return table

    def counts(
        self, probe: str, variant: str, region: str = ""
    ) -> list[tuple[float, dict[str, int]]]:
        """(yaw, confusion counts) of every view of a variant: everywhere, or in ".interior" or
        ".edge".
        """
        return [
            (
                float(view["yaw"]),
                {name: int(view["metrics"][f"occlusion.{name}{region}"]) for name in COUNTS},
            )
            for _, _, record in self.records(probe, variant)
            for view in record["views"]
        ]

    def cost(self, probe: str, variant: str, part: str) -> dict[str, float]:
        """Scene -> seconds of a stage ("steady", "warm", ...), mean over seeds."""
        found: dict[str, list[float]] = {}
        for scene, _, record in self.records(probe, variant):
            value = record["cost"]["seconds"].get(part)
            if value is not None:
                found.setdefault(scene, []).append(float(value))
        return {scene: sum(v) / len(v) for scene, v in found.items()}

    def rounds(self, stage: str, variant: str | None) -> list[list[float]]:
        """Seconds taken in turn by the timing probe: a list of rounds for each scene and seed,
        empty if there are none.

        Args:
            stage: "render" or "pair".
            variant: a contestant; None is the first contestant's second run.
        """
        found = []
        for cell in self.cells:
            if (
                cell["probe"] != "timing"
                or cell["record"] is None
                or (variant and variant not in cell["variants"])
            ):
                continue
            index = cell["variants"].index(variant) if variant else -1
            found.append([float(s) for s in cell["record"]["cost"]["rounds"][stage][index]])
        return found

    @property
    def timing_baseline(self) -> str | None:
        """The first contestant of the timing probe."""
        return next(
            (c["variants"][0] for c in self.cells if c["probe"] == "timing" and c["record"]), None
        )

    def counters(self, probe: str, variant: str) -> Counter[str]:
        """Work counters summed over a variant's cells."""
        total: Counter[str] = Counter()
        for _, _, record in self.records(probe, variant):
            total.update(record["cost"]["counters"])
        return total

    def lines(self, timings: bool = True) -> Iterable[str]:
        """results.jsonl: one line a (cell, figure of quality), sorted, so that a diff of two runs
        can be read.
        """
        rows = []
        for cell in self.cells:
            record = cell["record"]
            if record is None:
                continue
            names = sorted({name for view in record["views"] for name in view["metrics"]})
            for name in names:
                metric = metric_of(name)
                if metric.is_count:
                    continue  # counts that describe; they stay in the cell's own file
                values = {v["view"]: _shortened(v["metrics"].get(name)) for v in record["views"]}
                known = [v for v in values.values() if v is not None]
                row = {
                    "scene": cell["scene"],
                    "probe": cell["probe"],
                    "variant": cell["variants"][0],
                    "also": cell["variants"][1:],
                    "seed": cell["seed"],
                    "cell": cell["id"],
                    "metric": name,
                    "unit": metric.unit,
                    "direction": metric.direction,
                    "version": metric.version,
                    "value": _shortened(sum(known) / len(known)) if known else None,
                    "n": len(known),
                    "undefined": len(values) - len(known),
                    "views": values,
                    "counters": record["cost"]["counters"],
                }
                if timings:
                    row["seconds"] = record["cost"]["seconds"]
                    row["peak_memory_mb"] = record["cost"]["peak_memory_mb"]
                key = tuple(str(row[k]) for k in ("scene", "probe", "variant", "seed", "metric"))
                rows.append((key, canonical_json(row)))
        return [text for _, text in sorted(rows)]


def _shortened(value: float | None) -> float | None:
    """Nine significant digits: more than any tolerance asks for. The cells keep every bit."""
    return None if value is None else float(f"{value:.9g}")
