"""Oracles: the same search on an open bench finds its scene; bytes of the public folder; HMAC by hand; a key's owner's score."""

import hashlib
import json
import re
import shutil
import struct

import numpy as np
import pytest

from attnwarp.errors import InputError
from attnwarp.io import read_dataset, read_image, read_ply
from attnwarp_eval.bench import score, suite
from attnwarp_eval.drawn.axes import to_words
from attnwarp_eval.drawn.scenes import SceneDraft
from attnwarp_eval.scene.file import load_scene

SIZE, SCENE, VIEWS = 16, "drawn-0", ("source", "yaw010")


@pytest.fixture(scope="module")
def benches(tmp_path_factory):
    """Two sealed benches of the same settings, as (public folder, key's folder)."""
    made = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(suite.FIT, "iterations", 20)
        for _ in range(2):
            folder = tmp_path_factory.mktemp("sealed")
            pair = folder / "bench", folder / "key"
            suite.export(pair[0], count=1, size=SIZE, spp=1, targets=1, sealed=pair[1])
            made.append(pair)
    return made


def secret_of(key):
    return int(json.loads((key / suite.KEY).read_text())["secret"], 16)


def found(description, seeds=1000):
    """Seeds below ``seeds`` whose scene 0 lies where the described one does on every axis."""
    hits = []
    for seed in range(seeds):
        draft = SceneDraft(0, seed, {})
        draft.begin()
        if to_words(draft.axes) in description:
            hits.append(seed)
    return hits


def test_a_thousand_small_seeds_find_no_sealed_scene_but_an_open_one(benches):
    for _, key in benches:
        spec = load_scene(str(suite.truth_file(key, SCENE))).spec
        assert found(spec.description) == []
        assert secret_of(key) >= 2**128  # by chance once in 2^128 keys
    assert found(suite.draw(0, seed=612).spec.description) == [612]


def test_no_random_number_of_a_sealed_scene_comes_from_a_seed_that_can_be_tried(monkeypatch):
    def shortest(seed):
        """Bits of the longest number in the seed of each generator, and of these the fewest."""
        seeds = []
        with monkeypatch.context() as patch:
            make = np.random.default_rng
            patch.setattr(
                np.random, "default_rng", lambda entropy: seeds.append(entropy) or make(entropy)
            )
            for number in range(4):
                suite.draw(number, seed)
        assert len(seeds) > 100
        return min(max(int(part).bit_length() for part in one) for one in seeds)

    assert shortest(2**255) >= 200 and shortest(7) < 32


def test_no_file_of_a_sealed_bench_tells_the_secret_or_the_truth(benches):
    folder, key = benches[0]
    secret, names = secret_of(key), load_scene(str(suite.truth_file(key, SCENE))).object_names
    told = (folder / SCENE / "edits.json").read_text()  # the instruction names the thing
    names = [name.encode() for name in names if name not in told]
    hidden = [word.encode() for word in (str(secret), f"{secret:x}")]
    hidden += [secret.to_bytes(32, order) for order in ("big", "little")]
    files = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*.*")}
    pictures = ["images", *(f"masks/{edit}" for edit in suite.EDITS)]
    assert set(files) == {
        suite.FILE,
        "README.md",
        *(f"{SCENE}/{name}" for name in ("transforms.json", "splats.ply", "edits.json")),
        *(f"{SCENE}/sparse/0/{name}.txt" for name in ("cameras", "images", "points3D")),
        *(f"{SCENE}/{part}/{view}.png" for part in pictures for view in VIEWS),
    }
    for name, path in files.items():
        data = path.read_bytes()
        assert not [word for word in hidden if word in data], name
        if path.suffix in (".json", ".md", ".txt"):
            # Whole words: a scene may have a ring, and the README has a string.
            assert not [w for w in names if re.search(rb"\b%s\b" % re.escape(w), data)], name
        if path.suffix == ".png":
            assert set(chunks(data)) == {b"IHDR", b"IDAT", b"IEND"}
    assert {path.stat().st_mtime for path in folder.rglob("*")} == {suite.TIME}
    assert key.stat().st_mode & 0o077 == 0  # on the host's machine others can't read it
    assert (folder / SCENE / "sparse" / "0" / "points3D.txt").read_text().strip() == ""
    bench = json.loads(files[suite.FILE].read_text())
    assert bench["seed"] is None and len(bench["sealed"]) == 1 + 6


def chunks(png):
    at = 8
    while at < len(png):
        (length,) = struct.unpack(">I", png[at : at + 4])
        yield png[at + 4 : at + 8]
        at += 12 + length


def hmac_by_hand(key, text):
    """RFC 2104 in its own words."""
    block = key.ljust(64, b"\0")
    inner, outer = (bytes(b ^ pad for b in block) for pad in (0x36, 0x5C))
    return hashlib.sha256(outer + hashlib.sha256(inner + text).digest()).hexdigest()


def test_salted_hashes_differ_between_exports_and_for_equal_answers(benches):
    one, two = (suite.Suite.read(folder).sealed for folder, _ in benches)
    assert len(one) == len(two) == 7 and not set(one) & set(two)
    first, second = (secret_of(key) for _, key in benches)
    made = {secret: suite.salted("an answer", secret) for secret in (first, second)}
    assert made[first] != made[second]
    for secret, value in made.items():
        assert value == hmac_by_hand(secret.to_bytes(32, "big"), b"an answer")


def test_splats_of_a_sealed_bench_follow_from_its_public_files_alone(
    benches, monkeypatch, tmp_path
):
    monkeypatch.setitem(suite.FIT, "iterations", 20)
    place = benches[0][0] / SCENE
    data = read_dataset(place / "transforms.json")
    assert data.points is None
    again = suite.fitted_splats(data, tmp_path / "fit")
    stored = read_ply(place / "splats.ply")
    # A PLY has world coordinates in float32.
    np.testing.assert_allclose(again.world_means(), stored.world_means(), rtol=1e-7, atol=1e-5)


def test_a_sealed_bench_is_scored_with_its_key_alone(benches, tmp_path):
    (folder, key), (_, other) = benches
    true = key / SCENE / "truth" / "some_colour" / "blue"
    shutil.copytree(true, tmp_path / "in" / SCENE / "some_colour")
    (one,) = score.score(folder, tmp_path / "in", tmp_path / "out", key=key).scores
    # Of a thing that no pixel shows it is undefined: whatever the secret draws.
    assert not one.figures["error"] > 0
    places = [key / SCENE / "truth" / part / "yaw010" for part in ("source_pixel", "visible")]
    visible = read_image(places[1].with_suffix(".png"))[..., 0] == 255
    (tmp_path / "warps" / SCENE).mkdir(parents=True)
    points = np.load(places[0].with_suffix(".npy"))
    np.savez(tmp_path / "warps" / SCENE / "yaw010.npz", points=points, visible=visible)
    (one,) = score.score(folder, tmp_path / "warps", tmp_path / "out", key=key).scores
    assert not one.figures["wrong"] > 0
    for given, message in (
        (None, "is sealed"), (other, "not the key of"), (tmp_path, "lacks .*key.json"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            score.score(folder, tmp_path / "in", tmp_path / "out", key=given)


def test_a_key_inside_the_public_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match="given away"):
        suite.export(tmp_path, count=1, sealed=tmp_path / "key")


def test_a_sealed_export_goes_on_with_the_secret_it_began_with(benches, monkeypatch):
    folder, key = benches[1]
    before = suite.Suite.read(folder), secret_of(key)
    (folder / suite.FILE).unlink()
    again = suite.export(folder, count=1, size=SIZE, spp=1, targets=1, sealed=key)
    assert (again, secret_of(key)) == before
    assert (folder / suite.FILE).stat().st_mtime == suite.TIME
