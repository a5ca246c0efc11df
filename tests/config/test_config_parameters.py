"""What is recovered, as a configuration says it: keys that are tied, heightmaps and motions."""

from __future__ import annotations

from pathlib import Path

import pytest
from config.test_config_bad_input import PARAMETER, changed, line_of

from reslrb_cli.config.loader import dump, load
from reslrb_cli.config.parameters import ParameterSpec

POSE = """\
motion: {of: [lens, cap], free: [translation, rotation, scale]}
    initial: {translation: [0, 0.1, 0], rotation: 5}
    bounds: {rotation: [-10, 10], scale: [0.5, 2]}
    transform: {scale: sigmoid}
    learning_rate: {rotation: 0.5}"""


def test_a_motion_has_settings_by_word(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(changed(PARAMETER, POSE))
    config = load(path)
    [spec] = config.parameters
    assert spec.names == ["lens.translation", "lens.rotation", "lens.scale"]
    assert (spec.settings("translation").initial, spec.settings("translation").bounds) == ([0, 0.1, 0], None)
    assert (spec.settings("rotation").initial, spec.settings("rotation").bounds) == (5, (-10, 10))
    assert (spec.settings("rotation").learning_rate, spec.settings("scale").learning_rate) == (0.5, None)
    assert (spec.settings("scale").initial, spec.settings("scale").transform) == ("scene", "sigmoid")
    again = tmp_path / "again.yaml"
    again.write_text(dump(config))
    assert load(again).parameters == config.parameters


def test_one_learning_rate_and_transform_serve_all_words() -> None:
    spec = ParameterSpec(motion={"of": "lamp"}, learning_rate=0.1, transform="none")  # type: ignore[arg-type]
    assert spec.names == ["lamp.translation", "lamp.rotation"]
    assert spec.settings("rotation").learning_rate == spec.settings("translation").learning_rate == 0.1


def test_one_free_word_takes_plain_settings() -> None:
    spec = ParameterSpec(motion={"of": "lamp", "free": ["translation"]}, initial=[0, 1, 0], bounds=(-1, 1))  # type: ignore[arg-type]
    assert spec.settings("translation").initial == [0, 1, 0]
    assert spec.settings("translation").bounds == (-1, 1)


def test_a_heightmap_has_its_own_resolution() -> None:
    spec = ParameterSpec(heightmap={"mesh": ["slab", "other"], "resolution": [8, 4]}, bounds=(-0.1, 0.1))  # type: ignore[arg-type]
    assert spec.names == ["slab.heightmap"]
    assert (spec.settings().resolution, spec.settings().bounds) == ((8, 4), (-0.1, 0.1))


LENS = "motion: {of: lens}"
MAP = "heightmap: {mesh: a, resolution: [4, 4]}"
#: What stands in `parameters[0]`, and where the error is and what it holds.
WRONG = {
    "nothing": ("{initial: 1}", ("parameters[0]: must have one of `key`, `heightmap` and `motion`",)),
    "two kinds": (f"{{key: a, {LENS}}}", ("parameters[0].motion: cannot stand beside `key`",)),
    "key is a number": ("{key: 3}", ("parameters[0].key: must be text",)),
    "no keys": ("{key: []}", ("parameters[0].key: must have at least one entry",)),
    "key twice": ("{key: [a, a]}", ("parameters[0].key: must name each once",)),
    "tied and resampled": ("{key: [a, b], resolution: [4, 4]}", ("parameters[0].resolution: goes with one key",)),
    "moved twice": (
        f"{{{LENS}}}\n  - {{motion: {{of: [x, lens]}}}}",
        ("parameters[1].motion.of[1]: `lens` stands in",),
    ),
    "mesh twice": (f"{{{MAP}}}\n  - {{{MAP}}}", ("parameters[1].heightmap.mesh[0]: `a` stands in parameters[0]",)),
    "nothing moves": ("{motion: {of: []}}", ("parameters[0].motion.of: must have at least one entry",)),
    "nothing free": ("{motion: {of: a, free: []}}", ("parameters[0].motion.free: must have at least one entry",)),
    "unknown word": ("{motion: {of: a, free: [shear]}}", ("parameters[0].motion.free[0]: must be one of", "rotation")),
    "pivot of two": ("{motion: {of: a, pivot: [1, 2]}}", ("motion.pivot: must be a point, [x, y, z], not",)),
    "unknown key of a motion": ("{motion: {of: a, about: [1, 2, 3]}}", ("parameters[0].motion.about: unknown key",)),
    "no resolution": ("{heightmap: {mesh: a}}", ("parameters[0].heightmap.resolution: missing",)),
    "resolution of one": ("{heightmap: {mesh: a, resolution: [1, 4]}}", ("heightmap.resolution: must be at least",)),
    "huge": ("{heightmap: {mesh: a, resolution: [99999, 99999]}}", ("heightmap.resolution: must be at least",)),
    "resolution outside": (f"{{{MAP}, resolution: [4, 4]}}", ("parameters[0].resolution: belongs into `heightmap`",)),
    "motion with a resolution": (f"{{{LENS}, resolution: [4, 4]}}", ("parameters[0].resolution: has no effect",)),
    "word misspelt": (
        f"{{{LENS}, bounds: {{rotaton: [0, 1]}}}}",
        ("parameters[0].bounds.rotaton: unknown key; did you mean `rotation`?",),
    ),
    "word that is not free": (
        f"{{{LENS}, bounds: {{scale: [0, 1]}}}}",
        ("parameters[0].bounds.scale: has no effect", "translation, rotation"),
    ),
    "words without a motion": (
        "{key: a, bounds: {scale: [0, 1]}}",
        ("parameters[0].bounds: is a mapping by the words",),
    ),
    "one bound for two units": (f"{{{LENS}, bounds: [0, 1]}}", ("parameters[0].bounds: must be a mapping by what is",)),
    "one value for two units": (
        f"{{{LENS}, initial: 0}}",
        ("parameters[0].initial: must be a mapping by what is free",),
    ),
    "start that is text": (
        "{key: a, initial: grey}",
        ("[0].initial: must be a number", "{file: IMAGE}, {run: RUN}, or `scene`"),
    ),
    "file for a motion": (f"{{{LENS}, initial: {{file: a.png}}}}", ("parameters[0].initial: is an image file",)),
    "bounds of a word": (
        f"{{{LENS}, bounds: {{rotation: [1, 0]}}}}",
        ("parameters[0].bounds.rotation: ", "low < high"),
    ),
    "bounds of a word, one": (f"{{{LENS}, bounds: {{rotation: [1]}}}}", ("parameters[0].bounds.rotation: ", "two")),
    "sigmoid of a word": (
        f"{{{LENS}, transform: {{rotation: sigmoid}}}}",
        ("parameters[0].transform.rotation: sigmoid maps to finite `bounds`", "has none"),
    ),
    "start outside": (
        f"{{{LENS}, bounds: {{rotation: [0, 1]}}, initial: {{rotation: 2}}}}",
        ("parameters[0].initial.rotation: 2 is outside of the bounds [0, 1]",),
    ),
    "rate of a word": (f"{{{LENS}, learning_rate: {{rotation: 0}}}}", ("learning_rate.rotation: must be above 0",)),
    "attached is text": ("{key: a}\nintegrator: {attached: yes}", ("integrator.attached: must be auto",)),
    "attached of another": (
        "{key: a}\nintegrator: {type: prb, attached: true}",
        ("integrator.attached: not an option",),
    ),
    "normalization": (
        "{key: a}\nintegrator: {filter_normalization: none}",
        ("filter_normalization: must be attached",),
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_errors_are_located(case: str, tmp_path: Path) -> None:
    parameter, expected = WRONG[case]
    line = line_of(tmp_path, changed(PARAMETER, parameter))
    for part in expected:
        assert part in line
