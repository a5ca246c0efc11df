"""Page that compares two runs: settings, parameters, curves, and pictures side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from markupsafe import Markup

from reslrb_cli.config.yaml_text import flattened, parse
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.images import load_image
from reslrb_cli.records.sweeps import in_words
from reslrb_cli.report.page.images import show
from reslrb_cli.report.page.layout import key, lay_out
from reslrb_cli.report.page.run import guarded, outcome, read_text
from reslrb_cli.report.page.sweep import curves
from reslrb_cli.report.page.values import parameter_table, texture_pictures
from reslrb_cli.report.sources import ShownRun
from reslrb_cli.report.tonemap import exposure_words, shown_exposures


def compare_parts(runs: Sequence[ShownRun]) -> dict[str, Markup]:
    """Return the parts of a page that compares runs, by title and in order. Parts that do not apply are empty."""
    names = [run.name for run in runs]
    exposures = shown_exposures(runs[0].manifest.get("views"))  # the same for all, so that pictures compare

    def side_by_side(make: Callable[[ShownRun], Markup]) -> Markup:
        return lay_out("diagrams", [(key(run.name), guarded(lambda run=run: make(run))) for run in runs])  # type: ignore[misc]

    parts: dict[str, Callable[[], Markup]] = {
        "Outcome": lambda: side_by_side(lambda run: lay_out("paragraph", run.manifest.get("status")) + outcome(run)),
        "Settings that differ": lambda: lay_out("served.settings", names, differences(runs)),
        "Convergence": lambda: curves(names, [[run] if run.records else [] for run in runs]),
        "Images": lambda: side_by_side(lambda run: _pictures(run, exposures)),
        "Parameters": lambda: side_by_side(lambda run: parameter_table(run.results, "end")),
        "Textures": lambda: side_by_side(texture_pictures),
    }
    return {title: guarded(make) for title, make in parts.items()}


def differences(runs: Sequence[ShownRun]) -> list[tuple[str, list[str]]]:
    """Return the settings that differ between runs: the key, and the value in each run or an empty text."""
    flat = []
    for run in runs:
        try:
            flat.append(flattened(parse(read_text(run.path / "config.yaml"), "config.yaml")))
        except ConfigError:
            flat.append({})
    keys = dict.fromkeys(key for settings in flat for key in settings)
    rows = [(key, [in_words(settings[key]) if key in settings else "" for settings in flat]) for key in keys]
    return [(key, values) for key, values in rows if len(set(values)) > 1 and key not in ("run.name", "run.output")]


def _pictures(run: ShownRun, exposures: Mapping[str, float]) -> Markup:
    """Return a row per sensor with the target, and the last image or else the first one."""
    parts = Markup()
    for suffix, exposure in exposures.items():
        files = {name: run.path / "images" / f"{name}{suffix}.exr" for name in ("target", "final", "initial")}
        loaded = {name: image for name, file in files.items() if (image := load_image(file)) is not None}
        if "final" in loaded:
            loaded.pop("initial", None)
        shown = [
            show(image * exposure, f"{name}: {run.name}", lay_out("titled", name, "")) for name, image in loaded.items()
        ]
        remark = exposure_words(exposure, loaded.get("target"))
        parts += lay_out("gallery", shown, f"Sensor {suffix[1:]}" if suffix else "", remark)
    return parts
