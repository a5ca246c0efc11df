"""Tables of cases: functions whose results are compared in whole with stored ones (`said.check`)."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from golden import said
from kit import work_in

from reslrb_cli import errors

Case = Callable[[pytest.MonkeyPatch], Any]


class Cases(list[Case]):
    """The cases of a file. As a decorator, it adds a case. Each case is called in a folder of its own, and returns what
    is compared. Its name must be that of no other case of any file.
    """

    def __call__(self, case: Case) -> Case:
        self.append(case)
        return case

    def test(self) -> Callable[..., None]:
        """Return the test of all cases so far. Handlers of log lines stay as they were."""

        @pytest.mark.parametrize("case", list(self), ids=lambda case: case.__name__)
        def test_cases(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
            work_in(tmp_path, monkeypatch)
            handlers = logging.getLogger("reslrb_cli").handlers.copy()
            found = json.loads(json.dumps(shown(case(monkeypatch)), default=str))
            logging.getLogger("reslrb_cli").handlers[:] = handlers
            said.check(f"case {case.__name__}", said.masked(found, tmp_path), within=1e-3)

        return test_cases


def ending(function: Callable[..., Any], *given: Any, **more: Any) -> Any:
    """Return the result of a function, or its error."""
    try:
        return function(*given, **more)
    except (errors.ReslrbError, OSError, RuntimeError, ValueError) as error:
        return f"{type(error).__name__}: {error}"


def shown(value: Any) -> Any:
    """Return a result for JSON, arrays with all their numbers."""
    if isinstance(value, (list, tuple)):
        return [shown(each) for each in value]
    if dr.is_array_v(value) or isinstance(value, (np.ndarray, np.generic)):
        return np.array(value).astype(float).round(6).tolist()
    if isinstance(value, dict):
        return {str(key): shown(each) for key, each in value.items()}
    return said.plain(value)
