"""What is found out before anything is measured: references, dL/dI, and the border of the film."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.tiny import KEY, write_experiment

from reslrb_cli.config.loader import load
from reslrb_cli.measure.convergence.setup import Sampler, survey
from reslrb_cli.measure.methods import IMAGES
from reslrb_cli.optimization.assemble import assemble_scene

pytestmark = pytest.mark.usefixtures("llvm")
GAUSSIAN = ('<rfilter type="box"/>', '<rfilter type="gaussian"/>')


def problem(folder: Path, *changes: tuple[str, str], overrides: tuple[str, ...] = ()) -> Any:
    write_experiment(folder)
    text = (folder / "scene.xml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "scene.xml").write_text(text)
    return assemble_scene(load(folder / "tiny.yaml", list(overrides)))


def asked(what: Any, objective: str = "fixed", camera: bool = False, named: bool = True) -> Any:
    return survey(what, objective, camera=camera, named=named, budget_s=0.1)


def test_facts(tmp_path: Path) -> None:
    facts, arrays = asked(problem(tmp_path))
    assert (facts["keys"], facts["shapes"]) == ([KEY], {KEY: [4, 4, 3]})
    assert (facts["independent"], facts["why"], facts["without"]) == ({KEY: "ptracer"}, {KEY: ""}, {})
    assert (facts["pixels"], facts["masked"]) == (64, False)
    assert (arrays["adjoints"].shape, arrays["target-0"].shape) == ((1, 8, 8, 3), (8, 8, 3))
    assert arrays["mask"].all()


def test_the_loss_has_several_images(tmp_path: Path) -> None:
    _, arrays = asked(problem(tmp_path), "loss")
    assert arrays["adjoints"].shape == (IMAGES, 8, 8, 3)
    assert len({adjoint.tobytes() for adjoint in arrays["adjoints"]}) == IMAGES


@pytest.mark.parametrize(
    ("camera", "change", "masked"),
    [(True, GAUSSIAN, True), (False, GAUSSIAN, False), (True, ("box", "box"), False)],
)
def test_the_border_is_left_out_where_camera_paths_take_part(
    tmp_path: Path, camera: bool, change: tuple[str, str], masked: bool
) -> None:
    facts, arrays = asked(problem(tmp_path, change), camera=camera)
    assert facts["masked"] is masked
    inside = arrays["mask"][:, :, 0] == 1
    assert inside.all() is not masked
    assert bool(inside[4, 4])
    adjoint = np.abs(arrays["adjoints"][0]).sum(2)
    assert (adjoint[~inside] == 0).all()
    assert adjoint[4, 4] > 0
    facts, arrays = asked(problem(tmp_path, change), "image", camera=camera)
    assert (facts["shapes"], set(arrays)) == ({"image": [8, 8, 3]}, {"mask"})


def test_what_is_right_for_nothing_is_told(tmp_path: Path) -> None:
    facts, arrays = asked(problem(tmp_path, ("area", "directionalarea"), GAUSSIAN), camera=True, named=False)
    assert list(facts["without"]) == ["prb"]
    assert "directionalarea" in facts["without"]["prb"]
    assert facts["independent"] == {KEY: "ptracer"}
    assert arrays["mask"].all()  # it takes no part


@pytest.mark.parametrize("mode", ["known", "loss", "image"])
def test_steps_are_repeatable_and_the_border_counts_nothing(tmp_path: Path, mode: str) -> None:
    what = problem(tmp_path, GAUSSIAN, overrides=("run.adjoint=independent",))
    _, arrays = asked(what, "image" if mode == "image" else "loss", camera=True)
    sampler = Sampler(what.config, mode, arrays)
    row, times = sampler.step(3, 4, 0)
    assert row.shape == ((192,) if mode == "image" else (48,))
    assert row.any()
    assert times.wall_ms > 0
    again = sampler.step(3, 4, 0)[0]
    np.testing.assert_allclose(again, row, rtol=1e-4, atol=1e-6)
    assert not np.allclose(sampler.step(4, 4, 0)[0], row)
    if mode == "image":
        assert (row.reshape(8, 8, 3)[arrays["mask"][:, :, 0] == 0] == 0).all()
    if mode == "known":
        assert not np.allclose(sampler.step(3, 4, 1)[0], row, rtol=1e-6, atol=0)
