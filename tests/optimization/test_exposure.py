"""Exposures that are recovered: their gradient, and where the images cannot tell them from parameters."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import write_experiment

from reslrb_cli.config import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.statistics import compare
from reslrb_cli.optimization import assemble, optimize
from reslrb_cli.optimization.ambiguity import check_exposures, find_ambiguous
from reslrb_cli.optimization.samples import sample_gradient, take_gradient
