"""The configuration. One file is one experiment.

The descriptions of the fields give units, defaults and meanings. `scripts/make_reference.py` writes docs/config.md from
the descriptions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PrivateAttr,
    model_validator,
)
from typing_extensions import Self

from reslrb_cli.config.base import (
    ConfigPath,
    Positive,
    Section,
    Size,
    few,
    located,
    wrong,
)
from reslrb_cli.config.integrators import AnyIntegrator, Integrator, Own, ReslrbConfig, passes_obstacle
from reslrb_cli.config.optimizers import (
    L2,
    Adam,
    AnyOptimizer,
    Custom,
    Loss,
    Losses,
    loss_keys,
)
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.config.run import AUTO_SHARDS, RunConfig
from reslrb_cli.config.views import TargetConfig, ViewSpec, check_responses, check_views, fixed
from reslrb_cli.glasses import Glass, find_glass


def _scalar(value: Any) -> Any:
    if not isinstance(value, (bool, int, float, str)) or (isinstance(value, float) and not math.isfinite(value)):
        raise wrong("must be text, a finite number, true or false")
    return value


#: Name of `scene.file` if the scene is an `mi.Scene` in the memory of the process.
IN_MEMORY = "<mi.Scene>"


class SceneConfig(Section):
    """The scene and its cameras."""

    file: ConfigPath = Field(description="Mitsuba scene (XML, versions 0.4 to 3), relative to the config file.")
    options: dict[str, Annotated[bool | int | float | str, BeforeValidator(_scalar)]] = Field(default={})
    """Values of the scene file's `$name` variables."""
    size: Annotated[Size, few("pixels")] | None = None
    """[width, height] of the film of every sensor in pixels, without a crop window. The view stays the same if the
    ratio does. null: the size in the scene file."""
    cameras: ConfigPath | None = None
    """Cameras that replace the scene's sensors: NeRF's `transforms.json`, or COLMAP's `images.txt` with `cameras.txt`
    beside it. The path is relative to the config file. Every camera is a view, unless `views` selects some. The images
    that the file names, relative to it, are the targets of views without another target."""


# --- solids -----------------------------------------------------------------------------------------------------------


def _index(value: float | str) -> float | str:
    if isinstance(value, str):
        try:
            find_glass(value)
        except ValueError as error:
            raise wrong(str(error)) from None
    elif not 1 < value <= 5:
        raise wrong("must be above 1 and at most 5, or the name of a material")
    return value


class Fabrication(Section):
    """Solid of a lens or a mirror with a heightmap on its face, in millimetres. `reslrb export` writes and
    checks it.
    """

    #: Id of the shape that the light falls on.
    receiver: ClassVar[str] = "screen"

    kind: Literal["lens", "mirror"] = Field(default="lens", description="Whether the face refracts or reflects light.")
    face: Annotated[str, Field(min_length=1)] = "face"
    """Id of the mesh of the face: a grid about z = 0 that faces +z. The back is flat."""
    thickness: Positive = Field(description="Distance from z = 0 down to the back, in mm.")
    outline: Literal["rectangle", "round"] = "rectangle"
    """Outline of the solid. `round`: the ellipse inside the face; the face outside of it is cut off."""
    rim: Annotated[float, Field(ge=0)] = Field(default=0.0, description="Width of a flat rim around the face, in mm.")
    ior: Annotated[float | str, AfterValidator(_index)] = 1.49
    """Index of refraction of a lens, or the name of its material, such as `PMMA`."""
    sun: Annotated[float, Field(ge=0, lt=90)] = Field(
        default=0.53, description="Angular diameter of the light source, in degrees."
    )
    picture: ConfigPath | None = None
    """The picture before its dark parts were lifted, as the film sees it. The result is compared with it as well as
    with the target. null: only with the target."""

    @property
    def glass(self) -> Glass | None:
        """The material, if `ior` is a name."""
        return find_glass(self.ior) if isinstance(self.ior, str) else None

    @property
    def index(self) -> float:
        """Index of refraction, n_d of a material."""
        return find_glass(self.ior).nd if isinstance(self.ior, str) else self.ior


class Config(Section):
    """One checked experiment. Its paths are absolute."""

    variant: Literal[
        "auto", "llvm_ad_rgb", "cuda_ad_rgb", "llvm_ad_mono", "cuda_ad_mono", "llvm_ad_spectral", "cuda_ad_spectral"
    ] = "auto"
    """Mitsuba variant. `auto`: cuda_ad_rgb if Mitsuba can trace rays with it, otherwise llvm_ad_rgb. The spectral
    variants trace four wavelengths per path."""
    scene: SceneConfig = Field(description="The scene and its sensors.")
    target: TargetConfig = Field(description="The image to match.")
    views: Annotated[list[ViewSpec], Field(min_length=1)] | None = None
    """Sensors, each with its target. Settings that a view leaves out are those of `target`. null: the first sensor of
    the scene, or all of `scene.cameras`."""
    parameters: Annotated[list[ParameterSpec], Field(min_length=1)] = Field(description="Parameters to recover.")
    integrator: AnyIntegrator = Field(default=ReslrbConfig(), description="Method for image and gradient.")
    loss: Losses = Field(default=L2(), description="Difference between image and target to minimise.")
    optimizer: AnyOptimizer = Field(default=Adam(), description="Update rule of the parameters.")
    run: RunConfig = Field(default_factory=lambda: RunConfig(), description="Iterations, samples, seed and output.")
    fabrication: Fabrication | None = Field(default=None, description="The solid of a lens or a mirror, to export.")

    _source: Path = PrivateAttr(default=Path("config.yaml"))
    _allows_code: bool = PrivateAttr(default=False)
    _own_loss: Callable[..., Any] | None = PrivateAttr(default=None)
    _own_scene: Any = PrivateAttr(default=None)

    @property
    def adjoint(self) -> Literal["correlated", "independent", "batched"]:
        """Value of `run.adjoint` for a single step or shard, after `auto` is resolved.

        If shards split the samples of a view (`in_rounds`), `auto` becomes `independent`. Otherwise, `auto` becomes
        `batched` if `run.spp` can be split into `run.batches` batches and the passes, and if not, `independent`.
        """
        if self.in_rounds:
            return "independent"
        if self.run.adjoint != "auto":
            return self.run.adjoint
        return "batched" if self._splits(self.run.spp, self.run.batches) else "independent"

    def _splits(self, spp: int, sets: int) -> bool:
        """True if `spp` samples per pixel can be split into `sets` sets and the passes."""
        return spp % sets == 0 and _passes_divide(self.integrator, spp // sets)

    @property
    def shares_sensors(self) -> bool:
        """True if several views have one sensor. The loaded scene then has one sensor for each view."""
        return self.views is not None and len({view.sensor for view in self.views}) < len(self.views)

    @property
    def names_lamps(self) -> bool:
        """True if a view names the lamps that are on."""
        return any(view.lamps is not None for view in self.views or ())

    @property
    def drawn_views(self) -> int | None:
        """Number of views in an iteration, or None if only the scene determines it."""
        if self.views is None and self.scene.cameras is not None:
            trained = None
        else:
            trained = max(len(self.views or [None]) - len(self.run.held_out), 1)
        asked = self.run.views_per_iteration or trained
        return asked if trained is None or asked is None else min(asked, trained)

    @property
    def shards(self) -> int:
        """`run.shards` with `auto` resolved. If shards are whole views, `auto` gives the largest possible number of
        shards.
        """
        asked = self.run.shards
        if asked != "auto":
            return asked
        views = self.drawn_views or AUTO_SHARDS
        return self.shares * views if self.shares > 1 else min(views, AUTO_SHARDS)

    @property
    def shares(self) -> int:
        """Number of shards of each view's samples, or 1 if shards are whole views."""
        views, asked, spp = self.drawn_views, self.run.shards, self.run.spp
        if views is None:
            return 1
        if asked != "auto":
            return max(asked // views, 1)
        sets = self.run.batches if self.run.adjoint == "batched" else 1
        counts = [count for count in (16, 8, 4, 2) if count * views <= AUTO_SHARDS and spp % count == 0]
        return next((count for count in counts if self._splits(spp // count, sets)), 1)

    @property
    def share_spp(self) -> int:
        """Samples per pixel that one shard traces for a view."""
        return self.run.spp // self.shares

    @property
    def in_rounds(self) -> bool:
        """Whether a step has two rounds: the images of all shards, then their gradients."""
        return self.run.adjoint == "auto" and self.shares > 1

    @property
    def losses(self) -> list[Loss]:
        """The entries of `loss` as a list, even if `loss` is a single loss."""
        return [self.loss] if isinstance(self.loss, Loss) else list(self.loss)

    @property
    def allows_code(self) -> bool:
        """Whether Python files of the user may run. No setting in YAML changes it."""
        return self._allows_code

    @property
    def own_loss(self) -> Callable[..., Any] | None:
        """The function that was passed instead of a file (`loss.type: custom` without `file`)."""
        return self._own_loss

    def with_code(self, allowed: bool = True) -> Config:
        """Return a copy of the experiment. If `allowed` is True, the copy may run the Python files that it names."""
        config = self.model_copy()
        config._allows_code = allowed
        return config

    @property
    def own_scene(self) -> Any:
        """The `SceneInMemory` that was passed instead of a scene file, or None."""
        return self._own_scene

    def with_own_of(self, other: Config) -> Config:
        """Return this experiment with the loss function, the scene in memory and the code permission of `other`."""
        config = self.with_code(other._allows_code)
        config._own_loss = other._own_loss
        return config.with_scene(other._own_scene) if config.scene.file.name == IN_MEMORY else config

    def with_scene(self, scene: Any) -> Config:
        """Return the same experiment with a `SceneInMemory`, for a `scene.file` of the name `IN_MEMORY`."""
        config = self.model_copy()
        config._own_scene = scene
        return config

    def with_loss(self, loss: Callable[..., Any]) -> Config:
        """Return the same experiment with a function as its loss.

        The function is called as `loss(image, target)` with two `mi.TensorXf` (H, W, C), and with `weights` as the
        third argument if it takes three. It returns a `mi.Float` of width 1 that Dr.Jit differentiates.
        """
        config = self.model_copy(update={"loss": Custom(type="custom")})
        config._own_loss = loss
        return config

    @property
    def codes(self) -> dict[str, Custom | Own | ReslrbConfig]:
        """The user's own losses, integrators and estimators, as a mapping from the key that names each file."""
        integrators: dict[str, Integrator | None] = {"integrator": self.integrator}
        if self.target.render is not None:
            integrators["target.render.integrator"] = self.target.render.integrator
        own: dict[str, Custom | Own | ReslrbConfig] = {
            f"{key}.file": one for key, one in integrators.items() if isinstance(one, Own)
        }
        own |= {
            f"{key}.estimator": one
            for key, one in integrators.items()
            if isinstance(one, ReslrbConfig) and one.file is not None
        }
        return own | {key: one for key, one in loss_keys("file", self.loss) if isinstance(one, Custom)}

    @property
    def paths(self) -> dict[str, Path]:
        """The file or folder in each setting that names one, as a mapping from the key. The section `run` is left out,
        because it names only the place of the results.
        """
        found = dict(_paths(self.model_dump(exclude={"run"}), ""))
        return found | {key: one.path for key, one in self.codes.items() if one.path is not None}

    @property
    def by_pixel(self) -> bool:
        """Whether every loss is a sum of functions of single pixels."""
        return all(loss.type not in ("ssim", "custom") for loss in self.losses)

    @property
    def set_spp(self) -> int:
        """Samples per pixel of each set of samples in a step."""
        return self.share_spp // (self.run.batches if self.adjoint == "batched" else 1)

    def samples_obstacle(self, pixels: int) -> str | None:
        """Return why the samples of a step cannot be traced with films of `pixels` pixels, and what to change."""
        run, own = self.run, self.integrator.options().get("samples_per_pass")
        spp = self.set_spp
        obstacle = passes_obstacle(spp, own, pixels, splits=self.integrator.type in ("reslrb", "walk_ad", "trajectory"))
        return None if obstacle is None else f"{run.spp} {obstacle}"

    def with_exposures_fixed(self) -> Config:
        """Return the experiment with exposures of 1 in place of recovered exposures, and with the first response in
        place of a recovered one. For callers that need only the scene.
        """
        views = self.views and [fixed(view) for view in self.views]
        return self.model_copy(update={"target": fixed(self.target), "views": views})

    def step_options(self, shard: bool = False) -> dict[str, Any]:
        """Return the sampling options of a gradient step. If `shard` is True, return the sampling options of one shard
        instead.
        """
        options: dict[str, Any] = {"spp": self.share_spp if shard else self.run.spp, "adjoint": self.adjoint}
        if self.adjoint == "batched":
            options["batches"] = self.run.batches
        return options

    @property
    def source(self) -> Path:
        """The file of this configuration, as the user named it."""
        return self._source

    def __eq__(self, other: object) -> bool:
        """Return whether all settings are equal. The files from which the settings were read do not matter."""
        return isinstance(other, Config) and self.model_dump() == other.model_dump()

    __hash__ = None  # type: ignore[assignment]

    @model_validator(mode="before")
    @classmethod
    def _target_of_views(cls, data: Any) -> Any:
        """Fill in an empty `target` if views or cameras may supply all targets themselves."""
        if isinstance(data, dict) and data.get("target") is None:
            scene = data.get("scene")
            if data.get("views") is not None or (isinstance(scene, dict) and scene.get("cameras") is not None):
                return {**data, "target": {}}
        return data

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        if self.views is not None:
            check_views(self.views, self.scene, self.target)
        elif self.target.file is None and self.target.render is None and self.scene.cameras is None:
            raise located("target", "must have exactly one of `file` and `render`, and has none")
        check_responses(self.views, self.target)
        places: dict[tuple[str, str], int] = {}
        for i, spec in enumerate(self.parameters):
            for option, j, name in spec.objects():
                if places.setdefault((option, name), i) < i:
                    at = option if j is None else f"{option}[{j}]"
                    raise located(f"parameters[{i}].{at}", f"`{name}` is already in parameters[{places[option, name]}]")
            if self.optimizer.type == "auto":
                for option in ("learning_rate", "precondition"):
                    if getattr(spec, option) is not None:
                        raise located(f"parameters[{i}].{option}", "needs optimizer.type: adam or sgd; remove it")
        self._check_samples()
        if self.run.adjoint == "correlated" and self.integrator.options().get("weight") == "adjoint":
            raise located(
                "integrator.weight",
                "`adjoint` needs dL/dI before the paths are traced; run.adjoint: correlated has it later; "
                "set run.adjoint to auto, or the weight to luminance",
            )
        if self.target.render is not None:
            own = self.target.render.integrator
            key = "integrator" if own is None else "target.render.integrator"
            _check_passes(own or self.integrator, self.target.render.spp, key, "target.render.spp")
        return self

    def _check_samples(self) -> None:
        """Raise an error that names the key if the samples of a step cannot be split as configured."""
        _check_passes(self.integrator, self.run.spp, "integrator", "run.spp")
        self._check_shards()
        if self.scene.size is not None:
            obstacle = self.samples_obstacle(self.scene.size[0] * self.scene.size[1])
            if obstacle is not None:
                raise located("run.spp", obstacle)
        if "batches" in self.run.model_fields_set and self.run.adjoint not in ("auto", "batched"):
            raise located("run.batches", f"has no effect with run.adjoint: {self.run.adjoint}, only with batched")
        if self.run.adjoint == "batched":
            spp, what = self.share_spp, "run.spp" if self.shares == 1 else "the samples of a shard"
            if spp % self.run.batches:
                is_are = "is" if self.shares == 1 else "are"
                raise located("run.batches", f"{self.run.batches} does not divide {what}, which {is_are} {spp}")
            _check_passes(self.integrator, spp // self.run.batches, "integrator", f"{what} / run.batches")

    def _check_shards(self) -> None:
        """Raise an error that names the key if shards are neither whole views nor equal parts of one view."""
        asked, views, spp = self.run.shards, self.drawn_views, self.run.spp
        if asked == "auto" or views is None:
            return
        if asked > views and asked % views:
            raise located(
                "run.shards",
                f"is {asked}; with {views} views in an iteration it must be at most {views}, or a multiple of {views}",
            )
        if spp % self.shares:
            raise located("run.shards", f"{self.shares} per view do not divide run.spp, {spp}")
        _check_passes(self.integrator, self.share_spp, "integrator", "the samples of a shard")


def _passes_divide(integrator: Integrator, spp: int) -> bool:
    """Return whether `spp` samples per pixel can be split into the integrator's passes."""
    per_pass = getattr(integrator, "samples_per_pass", None)
    return per_pass is None or spp % min(per_pass, spp) == 0


def _check_passes(integrator: Integrator, spp: int, key: str, spp_key: str) -> None:
    if not _passes_divide(integrator, spp):
        per_pass = getattr(integrator, "samples_per_pass", None)
        raise located(f"{key}.samples_per_pass", f"{per_pass} does not divide {spp_key}, which is {spp}")


def _paths(value: Any, key: str) -> Iterator[tuple[str, Path]]:
    """Yield the paths in the settings, each with its key in the syntax of `--set`."""
    if isinstance(value, Path):
        yield key, value
    elif isinstance(value, Mapping):
        for name, each in value.items():
            yield from _paths(each, f"{key}.{name}" if key else str(name))
    elif isinstance(value, (list, tuple)):
        for place, each in enumerate(value):
            yield from _paths(each, f"{key}[{place}]")
