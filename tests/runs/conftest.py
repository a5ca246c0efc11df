"""Fixtures shared by the tests of resumed runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from cli import tiny
from kit import work_in
from runs.going_on import optimize, write_experiment

from reslrb_cli.runs import recorder as recording


@pytest.fixture
def experiment(llvm: str, workplace: Path) -> Path:
    """The working directory, which contains `tiny.yaml` with two parameters. The cache is empty at first."""
    write_experiment(workplace)
    return workplace


@pytest.fixture(scope="module")
def interrupted(llvm: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder of a run that has done 4 of 6 iterations. Its states are those after iterations 4 and 3."""
    folder = tmp_path_factory.mktemp("interrupted")
    tiny.write_experiment(folder)
    with pytest.MonkeyPatch.context() as patch:
        work_in(folder, patch)
        patch.setattr(recording, "write_report", lambda folder, *now: (folder / "report.html").write_text("<html>"))
        patch.setattr(recording, "seen_errors", lambda folder, results: {})
        records = recording.Recording.records
        patch.setattr(recording.Recording, "records", lambda self, stop: records(self, lambda: self.done == 4))
        code = optimize(
            "tiny.yaml", "--quiet", "--set", "run={iterations: 6, checkpoint_every: {iterations: 1}, spp: 4}"
        )
        assert code == 130
        patch.setattr(recording.Recording, "records", records)
        yield folder / "runs/tiny"
