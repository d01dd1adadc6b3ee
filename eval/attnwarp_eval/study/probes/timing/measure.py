"""Seconds of variants taken in turn in one process, for accuracy against time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

from attnwarp.warp import WarpSettings, render_surface, warp_view
from attnwarp_eval.cost import in_turn
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import InTurn, Probe, Work, register
from attnwarp_eval.study.record import Json, Record
from attnwarp_eval.study.results import Outcome
from attnwarp_eval.study.schema import Study
from attnwarp_eval.study.shared.splats import check_splats, splats_of, surface_spec


@dataclass(frozen=True)
class Rounds:
    """Seconds by contestant and round; the first contestant's second run comes last.

    Attributes:
        render: of the target's surface.
        pair: of render, correspondence, mask and feature grids.
    """

    render: list[list[float]]
    pair: list[list[float]]

    def to_json(self) -> Json:
        """The entry ``rounds`` of the record's cost."""
        return {"cost": {"rounds": asdict(self)}}


@register
class Timing(Probe[Rounds]):
    """One cell for all contestants: seconds of separate cells cannot be compared."""

    name = "timing"
    times_in_turn = ("render", "pair")

    def check(self, study: Study) -> None:
        """A variant without splats renders nothing."""
        check_splats(study, self.name, "time to take")

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene and seed, of the view in the middle."""
        for name, scene in scenes.items():
            views = study.views_of(scene)
            for seed in study.seeds:
                spec = {
                    **self.common_spec(study, scene, seed),
                    "views": [views[len(views) // 2]],
                    "feature_sizes": study.feature_sizes,
                    "rounds": study.timing_rounds,
                    "contestants": [
                        {
                            "settings": study.variants[label].settings().to_dict(),
                            **surface_spec(study, study.variants[label], seed),
                        }
                        for label in names
                    ],
                }
                yield Cell(spec, name, "all", self.name, seed, tuple(names))

    def compute(self, work: Work) -> Rounds:
        """Time every contestant in every round; see :func:`attnwarp_eval.cost.in_turn`."""
        spec, world = work.spec, work.world
        target = world.targets[spec["views"][0]]
        contestants = [
            (
                splats_of(work, {**spec, **contestant}),
                WarpSettings.from_dict(contestant["settings"]),
            )
            for contestant in spec["contestants"]
        ]
        sources = [render_surface(model, world.source, settings) for model, settings in contestants]

        def render(index: int) -> None:
            model, settings = contestants[index]
            render_surface(model, target, settings)

        def pair(index: int) -> None:
            model, settings = contestants[index]
            surface = sources[index]
            view = warp_view(
                model, world.source, target, settings, source_surface=surface, warn_empty=False
            )
            for layer in spec["feature_sizes"]:
                view.at((layer, layer))

        def timed(stage: Callable[[int], None]) -> list[list[float]]:
            works = [lambda _, index=index: stage(index) for index in range(len(contestants))]
            turns = in_turn(works, spec["rounds"], seed=spec["seed"])
            return [*turns.seconds, turns.again]

        work.meter.count(rounds=spec["rounds"], contestants=len(contestants) + 1)
        return Rounds(timed(render), timed(pair))

    def read_extra(self, data: Json) -> Rounds:
        """Read from the record's cost."""
        rounds = data["cost"]["rounds"]
        return Rounds(
            **{s: [[float(v) for v in row] for row in rounds[s]] for s in ("render", "pair")}
        )

    def in_turn(self, cell: Outcome, record: Record[Rounds]) -> InTurn:
        """The seconds of a cell."""
        spec = record.spec
        return InTurn(
            cell.variants,
            asdict(record.extra),
            spec["rounds"],
            record.cost.threads,
            f"view {spec['views'][0]} of each scene",
        )
