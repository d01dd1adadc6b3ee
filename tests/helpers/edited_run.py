"""A run of edited scenes whose pictures are plain colours, written as a run's folder has it."""

import io
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import yaml
from PIL import Image
from written_runs import record

from attnwarp_eval.study import Store, load_study
from attnwarp_eval.study.probes.editing.result import EditResult
from attnwarp_eval.study.run import expected, plan
from attnwarp_eval.study.shared.edit_truth import Judgement

METHODS = ("alone", "warped", "third")

SCENE = {
    "name": "ball",
    "title": "A ball",
    "objects": [{"name": "ball", "shape": {"type": "sphere", "center": [0, 0, 0.9], "radius": 0.9},
                 "texture": {"type": "checker", "colors": ["#c0c0c0", "#d0d0d0"], "size": 0.5}}],
    "lights": [{"type": "sky", "horizon": "#ffffff", "zenith": "#ffffff", "radiance": 0.8}],
    "cameras": {"look_at": [0, 0, 0.8], "radius": 3.5, "fov": 50, "size": [32, 32],
                "source": {"yaw": 0, "height": 1.5},
                "targets": [{"yaw": yaw, "height": 1.5} for yaw in (15, 30, 60, 90)]},
    "edits": [{"name": name, "source": "a ball",
               "target": f"a {name} ball", "changes": [{"object": "ball", "paint": value}]}
              for name, value in (("red", "#d03020"), ("blue", "#2040d0"))],
}  # fmt: skip


def jpeg(color):
    buffer = io.BytesIO()
    Image.new("RGB", (64, 64), color).save(buffer, "JPEG")
    return buffer.getvalue()


@dataclass
class Written:
    """A run's folder, and the colour of each method's pictures."""

    root: Path
    colors: dict[str, tuple[int, int, int]]


def write_run(folder, views=2, seeds=(1, 2), more=MappingProxyType({})):
    """A run of two edits and so many seeds; every picture of a method has its colour.

    ``more`` has further pictures of a method: their colours by what they show.
    """
    edits = [{**e, "instruction": f"paint it {e['name']}"} for e in SCENE["edits"]]
    (folder / "ball.yaml").write_text(yaml.safe_dump({**SCENE, "edits": edits}))
    names = ["yaw015", "yaw030", "yaw060", "yaw090"][:views]
    study = {
        "name": "people", "size": 32, "scenes": ["ball.yaml"], "seeds": list(seeds), "spp": 4,
        "variants": {method: {"method": "by_view", "options": {"steps": k + 1}}
                     for k, method in enumerate(METHODS)},
        "probes": {"editing": list(METHODS)},
        "pictures": {"variants": list(METHODS), "views": names},
    }  # fmt: skip
    (folder / "people.yaml").write_text(yaml.safe_dump(study))
    store = Store(folder / "run")
    planned = plan(load_study(str(folder / "people.yaml")), store)
    store.write_study(expected(planned))
    colors = {name: (60 * k + 40, 200 - 60 * k, 90) for k, name in enumerate(METHODS)}
    for cell in planned.cells:
        if cell.probe != "editing":
            continue
        edit = cell.spec["edit"]
        done = Judgement("edited", True, 30.0, 10.0, 10.0)
        extra = EditResult(edit["name"], edit["instruction"], done, done,
                           {"edit": {}, "render": {}}, {"edit": None, "render": None}, 30.0, 2, 0.0)  # fmt: skip
        data = record(
            [(f"{edit['name']}/{view}", 15.0, {}) for view in names],
            spec=cell.spec,
            **extra.to_json(),
        )
        data["id"] = cell.id
        for view in names:
            contents = {"before": (128, 128, 128), "render": colors[cell.variant]}
            for content, color in (contents | more.get(cell.variant, {})).items():
                path = store.pictures / cell.id[:16] / edit["name"] / f"{view}-{content}.jpg"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(jpeg(color))
                data["pictures"].append(
                    store.keep_picture(path, view=f"{edit['name']}/{view}", what=content)
                )
        store.write(data)
    return Written(store.root, colors)
