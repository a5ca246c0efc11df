"""What the program finds in scenes with every plugin (`said.check`): parameters, features, proposals and views."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli.every_plugin import ROWS, Row, write_files
from golden import said

from reslrb_cli.scene.catalog import summarise
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.needs import blend_warning, camera_finds_all, scene_needs, stock_clip, usual_paths
from reslrb_cli.scene.proposal import find_movable_in_view, propose
from reslrb_cli.scene.visibility import interior, sees_lamps, sees_specular

pytestmark = pytest.mark.usefixtures("combined")
#: Media, samplers and filters differ little in what the program finds.
ALIKE = ("medium", "phase", "volume", "sampler", "rfilter", "integrator")
LOADED = [row for row in ROWS if not row.loading and row.kind not in ALIKE]


@pytest.fixture(scope="module", autouse=True)
def folder(llvm: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Make a folder with the files that scenes name the working directory."""
    folder, before = tmp_path_factory.mktemp("files"), Path.cwd()
    write_files(folder)
    os.chdir(folder)
    yield
    os.chdir(before)


def described(file: str) -> dict[str, Any]:
    """Return all facts about the scene of a file, by name. Parameters are named by their keys."""
    gc.collect()  # Mitsuba asks emitters of former scenes, too
    scene = load_scene(Path(file))
    summary, sensors = summarise(scene), scene.sensors()
    found: dict[str, Any] = {f"parameter {info.key}": said.plain(info) for info in summary.parameters}
    found |= {f"sensor {view.index}": said.plain(view) for view in summary.sensors}
    found |= {name: getattr(summary, name) for name in ("emitters", "bsdfs", "shapes", "triangles", "movable")}
    if summary.sensors[0].view is None:
        return found
    needs = scene_needs(scene, sensors[0])
    found |= {f"needs {name}": said.plain(value) for name, value in vars(needs).items()}
    found["clip"] = stock_clip(needs)
    found["blends"] = blend_warning(SceneGraph.of(scene), needs.blends)
    found["paths"] = [usual_paths(scene, sensors, depth, hidden, moves)
                      for depth in (2, 4) for hidden in (False, True) for moves in (False, True)]  # fmt: skip
    found["camera finds all"] = [camera_finds_all(scene, depth, gloss) for depth in (2, 3) for gloss in (False, True)]
    for proposal in propose(scene, 0, lamps=True):
        found[f"proposal {proposal.info.key}"] = said.plain(proposal) | {"info": None}
    found["in view"] = find_movable_in_view(scene, 0)
    found["specular"] = [int(sees_specular(scene, sensors[0], partly).sum()) for partly in (False, True)]
    found["lamps"] = int(sees_lamps(scene, sensors[0]).sum())
    found["interior"] = int(interior((16, 16), sensors[0]).sum())
    return found


@pytest.fixture(scope="module")
def plain() -> dict[str, Any]:
    """Facts about the scene that all others extend."""
    Path("plain.xml").write_text(Row("", "").xml())
    return described("plain.xml")


def test_the_plain_scene(plain: dict[str, Any]) -> None:
    said.check("scene", plain)


@pytest.mark.parametrize("row", LOADED, ids=[row.name for row in LOADED])
def test_every_plugin(row: Row, plain: dict[str, Any]) -> None:
    Path("scene.xml").write_text(row.xml())
    found = described("scene.xml")
    said.check(f"scene with {row.name}", {key: value for key, value in found.items() if plain.get(key) != value})
