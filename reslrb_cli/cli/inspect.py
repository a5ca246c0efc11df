"""`reslrb inspect`: list the contents of a scene, and the parameters that can be recovered.

The argument is a scene file, a possibly incomplete configuration, or a run folder (`read_subject`). The output lists
the scene, its sensors, the plan of a step and the parameters (`templates/inspect.txt.j2`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from pydantic_core import to_jsonable_python

from reslrb_cli.cli.options import overrides_option, start_variant
from reslrb_cli.cli.terminal import fill
from reslrb_cli.config.loader import loads, parse_override, read_text
from reslrb_cli.config.parameters import is_named
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import parse, write
from reslrb_cli.errors import ConfigError, UnsupportedScene
from reslrb_cli.records.manifest import MANIFEST_FILE, read_manifest
from reslrb_cli.records.metrics import finite
from reslrb_cli.report.format import table

if TYPE_CHECKING:
    from reslrb_cli.integrators.plans import PlanRow
    from reslrb_cli.scene.catalog import ParameterInfo, SceneSummary, SensorSummary
    from reslrb_cli.scene.parameters import Selection


#: Placeholders for required sections that are missing in the configuration.
_STAND_INS = {"target": "{render: {spp: 1}}", "parameters": "[{key: '*'}]"}


@dataclass(frozen=True)
class Subject:
    """Configuration in which placeholders replace the sections listed in `missing`.

    `path` is the user's argument. `run` is the manifest if the configuration belongs to a run, otherwise None.
    """

    path: Path
    config: Config
    is_scene: bool
    missing: tuple[str, ...]
    run: dict[str, Any] | None


def read_subject(path: Path, overrides: tuple[str, ...]) -> Subject:
    """Read the scene, configuration or run at `path`, with `overrides` applied. Raises ConfigError."""
    manifest = read_manifest(path) if path.is_dir() else None
    if path.is_dir() and manifest is None:
        raise ConfigError(path, "", "is a folder without a run; name a scene file, a configuration or a run folder")
    file = path / "config.yaml" if manifest is not None else path
    if manifest is None and file.name == "config.yaml":
        manifest = read_manifest(file.parent)
    is_scene = _is_scene(file)
    text = write({"scene": {"file": str(file.absolute())}}) if is_scene else read_text(file)
    data = parse(text, str(file))
    given = {str(parse_override(override).location[0]) for override in overrides}
    sections = {key for key, value in data.items() if value is not None} if isinstance(data, dict) else set(_STAND_INS)
    if "views" in sections or "cameras" in _keys(data, "scene"):  # both supply targets
        sections |= {"target"}
    missing = tuple(section for section in _STAND_INS if section not in sections | given)
    stand_ins = [f"{section}={_STAND_INS[section]}" for section in missing]
    config = loads(text, file, [*stand_ins, *overrides])
    return Subject(path, config, is_scene, missing, manifest)


def _keys(data: Any, section: str) -> set[str]:
    """Return the keys of a section whose content is not checked yet."""
    inside = data.get(section) if isinstance(data, dict) else None
    return set(inside) if isinstance(inside, dict) else set()


def _is_scene(file: Path) -> bool:
    """True if the file is a scene rather than a configuration."""
    if file.suffix.lower() == ".xml":
        return True
    try:
        return file.is_file() and file.open("rb").read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
    except OSError:  # reading it later reports the error
        return False


#: Maximum number of listed sensors and recoverable parameters without `--all`.
LISTED_SENSORS, _LISTED = 3, 30

#: Maximum number of listed objects that can be moved.
_MOVED = 10


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "none"


def _sized(sensor: SensorSummary) -> str:
    (x, y), (width, height) = sensor.crop
    crop = "" if (x, y) == (0, 0) and (width, height) == sensor.size else f", crop {width}x{height} at ({x}, {y})"
    return f"{sensor.size[0]}x{sensor.size[1]}{crop}"


def plan_lines(rows: Sequence[PlanRow]) -> list[str]:
    """Format the plan as a table. The features that the plan contains come first."""
    ordered = sorted(rows, key=lambda row: not row.needed)
    return table([("needed" if row.needed else "left out", row.feature, row.reason) for row in ordered])


# --- parameters -------------------------------------------------------------------------------------------------------


def parameter_lines(infos: Sequence[ParameterInfo], wanted: Sequence[str], everything: bool) -> list[str]:
    """List the recoverable parameters with their values. Then print the number of other parameters, with reasons.

    Parameters that match a key or glob in `wanted` are marked. `everything` also lists the others.
    """
    usable = [info for info in infos if info.obstacle is None]
    others = [info for info in infos if info.obstacle is not None]
    marked = {info.key for info in usable if is_named(info.key, wanted)}
    shown = usable if everything else sorted(usable, key=lambda info: info.key not in marked)[:_LISTED]
    rows = [("* " * (info.key in marked) + info.key, _noted(info)) for info in shown]
    note = " (* in `parameters`)" if marked else ""
    lines = [f"can be recovered: {len(usable) or 'none'}{note}", *(f"  {line}" for line in table(rows))]
    if len(shown) < len(usable):
        lines.append(f"  and {len(usable) - len(shown)} more; --all lists them")
    if everything:
        told = [(info.key, _value(info), _flags(info), str(info.obstacle)) for info in others]
        return [*lines, f"others: {len(others)}", *(f"  {line}" for line in table(told))]
    if others:
        lines.append(f"others: {len(others)}; --all lists them")
        lines += [f"  {line}" for line in _reasons(others)]
    return lines


def moving_lines(movable: Sequence[Mapping[str, Any]], everything: bool) -> list[str]:
    """List the movable objects, grouped by the options that move the objects."""
    lines = [f"can be moved: {len(movable) or 'nothing'}"]
    if everything:
        return lines + [f"  {line}" for line in table([(item["id"], ", ".join(item["by"])) for item in movable])]
    groups: dict[str, list[str]] = {}
    for item in movable:
        groups.setdefault(" and ".join(item["by"]), []).append(item["id"])
    for by, ids in groups.items():
        more = f" and {len(ids) - _MOVED} more; --all lists them" if len(ids) > _MOVED else ""
        lines.append(f"  by {by}: {', '.join(ids[:_MOVED])}{more}")
    return lines


def _reasons(others: Sequence[ParameterInfo]) -> list[str]:
    """Count the parameters with each reason."""
    groups: dict[str, list[str]] = {}
    for info in others:
        # Details in brackets differ between parameters.
        groups.setdefault(str(info.obstacle).partition(" (")[0].partition(";")[0], []).append(info.key)
    counted = sorted(groups.items(), key=lambda group: -len(group[1]))
    return table([(str(len(keys)), reason) for reason, keys in counted], "><")


def _value(info: ParameterInfo) -> str:
    """Format a value. A few numbers have the form of `initial`. More numbers appear as count, mean and range."""
    value = info.value
    if value is not None and value.numbers is not None:
        words = [f"{number:.4g}" for number in value.numbers]
        return f"[{', '.join(words)}]" if info.shape else words[0]
    if len(info.shape) == 3:
        height, width, channels = info.shape
        size = f"{width}x{height} texels" + (f" of {channels}" if channels > 1 else "")
    else:
        size = f"{'x'.join(map(str, info.shape))} numbers" if info.shape else info.type
    if value is None or info.kind == "shape" or "AffineTransform" in info.type:
        return size if info.shape else info.type
    return f"{size}, mean {value.mean:.4g}, {value.low:.4g} to {value.high:.4g}"


def _noted(info: ParameterInfo) -> str:
    """Format a value and the remark about it."""
    return _value(info) + (f"; {info.remark}" if info.remark is not None else "")


def _flags(info: ParameterInfo) -> str:
    return ("" if info.differentiable else "not ") + "differentiable" + ", discontinuous" * info.discontinuous


@click.command("inspect")
@click.argument("path", metavar="PATH", type=click.Path(path_type=Path))
@overrides_option
@click.option("--all", "everything", is_flag=True, help="Also list parameters that cannot be recovered.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object with all data instead of lines.")
def command(
    path: Path,
    overrides: tuple[str, ...],
    everything: bool,
    as_json: bool,
) -> int | None:
    """List the parameters of a scene that can be recovered, with their current values, and the contents of the scene.

    PATH is a scene file (XML), a configuration or a run folder. The configuration may be incomplete. The command first
    lists the parameter keys that `parameters` of a configuration may use. For all other keys, the command gives the
    reason why a configuration cannot use the key. If the configuration has `parameters`, the plan of a step lists the
    features that its kernels contain or leave out, and why.
    """

    subject = read_subject(path, overrides)
    config = subject.config
    start_variant(config)
    from reslrb_cli.optimization.loading import load_configured
    from reslrb_cli.scene.catalog import summarise

    scene = load_configured(config, selects="parameters" not in subject.missing)
    summary = summarise(scene, config.integrator.hide_emitters)
    selection = None if "parameters" in subject.missing else select(config, scene)
    edges = [] if selection is None or isinstance(selection, str) else edges_of(scene, selection)
    plan = None if selection is None else make_plan(subject, scene, selection)
    if as_json:
        known = {"run": subject.run, **vars(summary)}
        known |= {"plan": {"obstacle": plan} if isinstance(plan, str) else plan and {"rows": plan}, "edges": edges}
        # Objects of the scene are written as their ids.
        data = to_jsonable_python(known, inf_nan_mode="constants", fallback=lambda item: item.id())
        click.echo(json.dumps(finite(data, str), indent=2, allow_nan=False))
        return None
    wanted = [] if "parameters" in subject.missing else [key for spec in config.parameters for key in spec.keys]
    parameters = parameter_lines(summary.parameters, wanted, everything)
    text = fill(
        "inspect.txt.j2",
        {
            "counted": _counted,
            "sized": _sized,
            "shares": lambda view: ", ".join(f"{name} {100 * share:.0f} %" for name, share in vars(view).items()),
        },
        path=path,
        run=None if subject.run is None else run_words(subject.run),
        scene=config.scene.file,
        summary=summary,
        sensors=summary.sensors if everything else summary.sensors[:LISTED_SENSORS],
        plan=[f"none: {plan}"] if isinstance(plan, str) else plan and plan_lines(plan),
        parameters=[*parameters, *moving_lines(summary.movable, everything)],
        edges=edges,
        next=next_step(subject, summary),
    )
    click.echo(text, nl=False)
    return None


def run_words(run: Mapping[str, Any]) -> str:
    """Describe the status of a run from its manifest."""
    iterations = run.get("results", {}).get("iterations")
    words = [str(run.get("status")), "" if iterations is None else f"{iterations} iterations"]
    return ", ".join(word for word in [*words, str(run.get("error") or "")] if word)


def next_step(subject: Subject, summary: SceneSummary) -> str:
    """Suggest the next step to the user."""
    keys = [info.key for info in summary.parameters if info.obstacle is None]
    if summary.sensors and all(sensor.obstacle == sensor.camera_obstacle is not None for sensor in summary.sensors):
        return "change the scene so that it can be rendered; the reason above says how"
    if not keys:
        return "no parameter can be recovered; the reasons above say what to change in the scene file"
    sections = {"target": "target: {file: IMAGE}", "parameters": f"parameters: [{{key: {json.dumps(keys[0])}}}]"}
    missing = " and ".join(f"`{sections[section]}`" for section in subject.missing)
    if subject.is_scene:
        return f"`reslrb init {subject.path} --target PHOTO` writes a configuration"
    if missing:
        return f"add {missing} to {subject.path}, then run `reslrb optimize {subject.path}`"
    return f"`reslrb optimize {subject.config.source}`" + (" runs it again" if subject.run else " runs it")


def select(config: Config, scene: Any) -> Selection | str:
    """Return the parameters to recover, or the reason why the parameters cannot be recovered. Sets initial values in
    `scene`.
    """
    from reslrb_cli.scene.parameters import select_parameters

    try:
        return select_parameters(scene, config.parameters, config.source)
    except ConfigError as error:
        return str(error)


def edges_of(scene: Any, selection: Selection) -> list[str]:
    """Return the ids of moving shapes with silhouettes or shadows."""
    from reslrb_cli.scene.deformation import where_moved

    moved = where_moved(selection.params, selection.scene_keys)
    return [item.id for item in moved if item.casts_edges(scene)]


def make_plan(subject: Subject, scene: Any, selection: Selection | str) -> list[PlanRow] | str:
    """Plan a step for the first sensor in use. Return the plan's rows, or the reason if there is no plan.

    Afterwards the selected parameters of `scene` track derivatives.
    """
    import drjit as dr

    from reslrb_cli.integrators.reslrb import Reslrb
    from reslrb_cli.optimization.autotune.sampling import as_decided, decided, open_settings, plan_rows
    from reslrb_cli.optimization.loading import choose_sensors, make_configured, pass_spp, paths_of, what_moves
    from reslrb_cli.records.decisions import Decision

    config = subject.config
    if isinstance(selection, str):
        return selection
    if config.integrator.type != "reslrb":
        return f"integrator.type is {config.integrator.type}; only `reslrb` has a plan"
    try:
        decisions = decided(config, map(Decision.from_json, (subject.run or {}).get("decisions", ())))
    except TypeError as error:
        raise ConfigError(config.source.parent / MANIFEST_FILE, "decisions", str(error)) from None
    try:
        [sensor, *_] = sensors = choose_sensors(config, scene)
        paths = paths_of(config.integrator, scene, sensors, what_moves(config, selection))
        integrator = as_decided(make_configured(config, config.integrator, paths, scene), decisions)
        assert isinstance(integrator, Reslrb)
        integrator.expect(pass_spp(config))
        params = selection.params
        for key in selection.scene_keys:
            leaf = type(params[key])(dr.detach(params[key]))
            dr.enable_grad(leaf)
            params[key] = leaf
        params.update()
        plan = integrator.plan(scene, scene.sensors()[sensor], params)
    except (ConfigError, UnsupportedScene) as error:
        return str(error)
    if not decisions:
        open_ = open_settings(config, paths)
        open_ += ["edges"] if edges_of(scene, selection) and config.integrator.options().get("edges") == "auto" else []
        decisions = [Decision(setting=setting, value="auto", why="which a run decides") for setting in open_]
    return plan_rows(plan, decisions)
