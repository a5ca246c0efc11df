"""User-defined integrators and estimators that are loaded from a file. Each error message has one line.

User-defined integrators need Mitsuba's methods `render` and `render_backward`. `mi.ad.integrators.common.ADIntegrator`
and `RBIntegrator` provide both methods for classes with `sample`.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.config.base import code_file
from reslrb_cli.config.code import guarded, load_named
from reslrb_cli.errors import ConfigError
from reslrb_cli.estimators import add_own, check_own
from reslrb_cli.estimators.base import Estimator, Pass
from reslrb_cli.integrators.baselines import Replayed
from reslrb_cli.integrators.protocol import Job, StepIntegrator
from reslrb_cli.scene.files import digest_of

#: Digests of the files of estimators that have been loaded, by FILE.py:CLASS.
_loaded: dict[str, str] = {}


def load_estimator(place: str, source: object, key: str) -> str:
    """Load the estimator FILE.py:CLASS, unless the same file is already loaded. Return its name in `ESTIMATORS`.

    The caller has checked that the code may run. Raises ConfigError, located at `key` of `source`.
    """
    file, _, name = place.rpartition(":")
    digest = digest_of(Path(file))
    if _loaded.get(place) != digest:
        kind = load_named(Path(file), name, source, key)
        check_own(kind, source, key)
        add_own(place, _with_guards(kind, Path(file), name))
        _loaded[place] = digest
    return place


def _with_guards(kind: Any, file: Path, name: str) -> type[Estimator]:
    """Return the class with methods whose errors have one line."""

    def forward(self: Estimator, p: Pass) -> Any:
        with guarded(file, name, file, "its forward"):
            return kind.forward(self, p)

    def backward(self: Estimator, p: Pass, state: Any) -> None:
        with guarded(file, name, file, "its backward"):
            kind.backward(self, p, state)

    return type(kind.__name__, (kind,), {"forward": forward, "backward": backward, "__doc__": kind.__doc__})


class OwnIntegrator(StepIntegrator):
    """User's integrator in a step. An exception or a wrong image is reported in one line that names the class.

    The file runs when an image or a gradient is first needed, or in `ready`.
    """

    def __init__(
        self, file: str, max_depth: int, rr_depth: int, hide_emitters: bool, arguments: dict[str, Any] | None = None,
        paths: str = "camera", allowed: bool = False,
    ) -> None:  # fmt: skip
        """Prepare the class FILE.py:CLASS. The class is constructed from a `mi.Properties` with these options and
        `arguments`.

        Of `max_depth`, `rr_depth` and `hide_emitters`, the class receives only those options that it reads. `paths` are
        for checks (`config.Own`). Code runs only if `allowed`.
        """
        self.file, self.name, self.allowed = code_file(file), file.rpartition(":")[2], allowed
        self._options = {"max_depth": max_depth, "rr_depth": rr_depth, "hide_emitters": hide_emitters}
        self._arguments = arguments or {}

    def ready(self) -> None:
        """Run the file and make the integrator.

        Raises ConfigError, which names the file, if code is not allowed or fails. Also raises ConfigError if the class
        does not read one of the `arguments`.
        """
        _ = self._work

    @cached_property
    def _work(self) -> Replayed:
        if not self.allowed:
            raise ConfigError(self.file, self.name, "would run with all your rights; --allow-code permits it")
        found = load_named(self.file, self.name, self.file, self.name)
        options = mi.Properties("custom")
        for key, value in {**self._options, **self._arguments}.items():
            options[key] = value
        with self._guarded("making it"):
            plugin = found(options)
        if not isinstance(plugin, mi.Integrator):
            raise ConfigError(
                self.file, self.name, f"is not a Mitsuba integrator, but creates a {type(plugin).__name__}"
            )
        unknown = [key for key in options.unqueried() if key in self._arguments]
        if unknown:
            raise ConfigError(self.file, self.name, f"has no option {', '.join(unknown)}")
        return Replayed(plugin)

    def image(self, job: Job) -> mi.TensorXf:
        self.ready()
        with self._guarded("its render"):
            image = self._work.image(job)
        return self._checked(job, image)

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        self.ready()
        with self._guarded("its render_backward"):
            self._work.backward(job, gradient)

    def tangent(self, job: Job) -> mi.TensorXf:
        """Return the image's derivative along the tangents of the job's parameters, computed by the class's
        `render_forward`.
        """
        plugin = self._work.plugin
        with self._guarded("its render_forward"), dr.resume_grad():
            image = plugin.render_forward(job.scene, job.params, job.sensor, job.seed, job.spp)
        return self._checked(job, image)

    def _guarded(self, what: str) -> AbstractContextManager[None]:
        return guarded(self.file, self.name, self.file, what)

    def _checked(self, job: Job, image: Any) -> mi.TensorXf:
        """Return the image if it has the size of the film. Raises ConfigError otherwise."""
        width, height = (int(n) for n in job.sensor.film().crop_size())
        shape = tuple(image.shape) if isinstance(image, mi.TensorXf) else None
        if shape is None:
            raise ConfigError(self.file, self.name, f"its render returns {type(image).__name__}, not mi.TensorXf")
        if shape[:2] != (height, width) or len(shape) != 3:
            said = "x".join(str(n) for n in shape)
            raise ConfigError(
                self.file, self.name, f"its image is {said}, not {height}x{width} (height, width) with channels"
            )
        return image
