"""Live view of a run: a progress bar and, in a notebook, a figure that is updated."""

from __future__ import annotations

import contextlib
import io
import math
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.figure import Figure
from tqdm.auto import tqdm

from reslrb_cli.optimization.problem import ErrorMeter
from reslrb_cli.records.measurement_files import LivePage
from reslrb_cli.records.metrics import Record
from reslrb_cli.report.run_summary import descriptions
from reslrb_cli.report.tonemap import encode, exposure_for

Array: TypeAlias = "np.ndarray[Any, Any]"


def watched(
    records: Generator[Record, None, None], total: int, done: int, meter: ErrorMeter, draw: Callable[[], bytes] | None
) -> Iterator[Record]:
    """Yield `records` and show the progress.

    A bar counts from `done` to `total` iterations. In a notebook, the PNG that `draw` returns is updated now and then.
    When the loop ends for any reason, the bar and the figure show the last iteration.
    """
    show = None if draw is None else _notebook()

    def refresh() -> None:
        if draw is not None and show is not None:
            show(draw())

    page, seen = LivePage(refresh, "the figure"), 0
    with contextlib.closing(records), tqdm(total=total, initial=done, unit="it") as bar:
        try:
            for record in records:
                bar.set_description_str(descriptions(record, meter)[-1], refresh=False)
                bar.update()
                seen += 1
                page.refresh()
                yield record
        finally:
            if seen:
                with contextlib.suppress(Exception):  # a figure that cannot be drawn must not end the run
                    refresh()


def _notebook() -> Callable[[bytes], None] | None:
    """Return a function that shows a PNG in the notebook cell in place of the previous PNG. Return None without a
    notebook.
    """
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if shell is None or getattr(shell, "kernel", None) is None:
        return None
    from IPython.display import Image, display

    handle: list[Any] = []

    def show(png: bytes) -> None:
        if handle:
            handle[0].update(Image(data=png))
        else:
            handle.append(display(Image(data=png), display_id=True))

    return show


def drawn(records: Sequence[Record], known: Iterable[str], image: Array, target: Array) -> bytes:
    """Return a PNG with the loss, the errors of the `known` parameters, and an image (H, W, C) beside its target.

    `known` names the parameters whose true values are known.
    """
    figure = Figure(figsize=(10, 3), layout="constrained")
    curves, *pictures = figure.subplots(1, 3, width_ratios=(1.4, 1, 1))
    iterations = [record.iteration for record in records]
    curves.plot(iterations, [record.loss for record in records], label="loss")
    for key in known:
        errors = [record.parameter_errors.get(key, math.nan) for record in records]
        curves.plot(iterations, errors, label=f"error of {key}", linewidth=1)
    curves.set(yscale="log", xlabel="iteration")
    curves.legend(fontsize=7)
    exposure = np.float32(exposure_for(target))
    for axes, shown, title in zip(pictures, (image, target), ("now", "target"), strict=True):
        values = np.clip(np.nan_to_num(shown[:, :, : 3 if shown.shape[2] >= 3 else 1] * exposure), 0, 1)
        axes.imshow(encode(values), cmap="gray")
        axes.set(xticks=[], yticks=[], title=title)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    return file.getvalue()
