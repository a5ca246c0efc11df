"""What a run writes down: its folder, manifest, metrics, checkpoints, images and parameters, and its clock readings."""

from __future__ import annotations

from reslrb_cli.records.checkpoint import save_checkpoint
from reslrb_cli.records.clock import StepClock, StepTimes
from reslrb_cli.records.images import write_image
from reslrb_cli.records.manifest import Manifest, Status
from reslrb_cli.records.metrics import MetricsWriter, Record, read_metrics
from reslrb_cli.records.parameters import write_mask, write_parameters
from reslrb_cli.records.run_folder import RunFolder, check_output

__all__ = [
    "Manifest",
    "MetricsWriter",
    "Record",
    "RunFolder",
    "Status",
    "StepClock",
    "StepTimes",
    "check_output",
    "read_metrics",
    "save_checkpoint",
    "write_image",
    "write_mask",
    "write_parameters",
]
