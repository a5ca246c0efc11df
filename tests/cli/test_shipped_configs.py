"""Every shipped experiment runs to its end unchanged. The run recovers the stated parameters within the README's
time.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from reslrb_cli.cli import main
from reslrb_cli.records.manifest import read_manifest

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = sorted((ROOT / "configs").rglob("*.yaml"))
#: Largest final error of a parameter, as a share of the initial error, over the texels that light and sensor reach.
MOST = 0.2
#: How many times slower a machine may be than the machine of the README.
SLOWER = 4
#: Larger limits that the README states for single parameters.
MOST_OF = {"painting.reflectance.data": 0.5}


def stated_seconds(name: str) -> float:
    """Return the time that the README's table of results states for an experiment. The row begins with the experiment's
    name.
    """
    found = re.search(rf"^\| `{re.escape(name)}`.*\| (\d+) s \|", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert found is not None, f"{name} has no row with a time in the README's table of results"
    return float(found[1])


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT / "configs").with_suffix(""))


@pytest.mark.parametrize("config", CONFIGS, ids=name_of)
def test_the_readme_states_the_time(config: Path) -> None:
    assert stated_seconds(name_of(config)) > 0


@pytest.mark.long
@pytest.mark.parametrize("config", CONFIGS, ids=name_of)
def test_it_recovers_the_stated_parameters(config: Path, tmp_path: Path) -> None:
    """The time of the iterations is at most four times the stated time. The README's times come from another
    machine.
    """
    main.main(
        ["optimize", str(config), "--set", f"run.output={tmp_path}", "--set", "run.name=it"], standalone_mode=False
    )
    results = read_manifest(tmp_path / "it")["results"]
    errors = results["parameter_rmse"]
    print(name_of(config), f"{results['elapsed_s']:.0f} s", errors)
    assert errors, "no true value is known"
    for key, error in errors.items():
        assert error["final"] <= MOST_OF.get(key, MOST) * error["initial"], key
    assert results["worse"] == []
    assert results["elapsed_s"] <= SLOWER * stated_seconds(name_of(config))
