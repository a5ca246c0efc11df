"""Shared setup of the lens tests: one lens, and fewer samples for quantities that no test measures."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from cli.tiny import done, settings

from reslrb_cli.records.images import write_file
from reslrb_cli.runs import export, workshop


@contextmanager
def few_samples() -> Iterator[None]:
    """Reduce the rays that measure where light goes, and the samples of the solid's picture. Otherwise, they take
    seconds in every run.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workshop, "SHARE_RAYS", 2**16)  # the error of a share is at most 2e-3
        patch.setattr(export, "PICTURE_SPP", 4)
        yield


@pytest.fixture(autouse=True, scope="module")
def _few_samples() -> Iterator[None]:
    with few_samples():
        yield


@pytest.fixture(scope="session")
def lens(tmp_path_factory: pytest.TempPathFactory, llvm: str) -> Path:
    """Folder with a lens at its start (`lens`), a run of one iteration (`runs/lens`), and an export of this run with
    tolerances (`out`, and `moved` for tests that write files beside it). The output of the export is in `said.txt`. The
    lens is 75 mm wide and 100 mm high.
    """
    from lens.test_experiment import picture

    folder = tmp_path_factory.mktemp("lens")
    image = np.repeat(picture(32, 24)[:, :, None], 3, 2).astype(np.float32)
    write_file(folder / "p.exr", image, linear=True)
    done("lens", folder / "p.exr", "-o", folder / "lens", "--pixels", "32", "--ior", "PMMA")
    sets = ("run.iterations=1", "run.spp=4", "run.final_spp=24", "run.certainty=false")
    with few_samples():
        said = done("optimize", folder / "lens/lens.yaml", *settings(f"run.output={folder}/runs", *sets)).output
        assert "runs/lens -o FOLDER` writes the solid" in said  # the next command
        said = done("export", folder / "runs/lens", "-o", folder / "out", "--tolerances").output
    (folder / "said.txt").write_text(said)
    shutil.copytree(folder / "out", folder / "moved")
    return folder
