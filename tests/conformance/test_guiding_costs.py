"""What guided emission costs a step: nothing where it is off, and no kernel that is compiled anew where it learns."""

from __future__ import annotations

import pytest
from conformance.test_guiding import guided, learn

from reslrb_cli.integrators.features import FEATURES
from reslrb_cli.integrators.plan_report import LARGE, count, tracking

pytestmark = pytest.mark.usefixtures("llvm")


def test_without_a_guide_nothing_of_it_is_compiled() -> None:
    [feature] = [feature for feature in FEATURES if feature.name == "guided emission"]
    scene, ours, plain = guided("two_emitters", 0)
    operations = {}
    for name, each in (("on", ours), ("off", plain)):
        with tracking(scene.params, scene.keys):
            plan = each.plan(scene.scene, scene.scene.sensors()[0], scene.params)
            assert feature.needed(plan) == (name == "on")
            for toggled in (plan, feature.toggle(plan)):
                kind = "on" if feature.needed(toggled) else "off"
                operations[name, kind] = sum(count(each, toggled, scene.scene, scene.scene.sensors()[0], known=True))
    assert operations["on", "on"] == operations["off", "on"]
    assert operations["on", "off"] == operations["off", "off"] < operations["on", "on"]


def test_later_steps_compile_nothing() -> None:
    """Though they learn: neither table nor seed reaches a kernel as a literal."""
    from conformance.test_kernels import Kernels

    scene, ours, _ = guided("two_emitters", 0)
    kernels = Kernels()
    kernels.new(lambda: learn(scene, ours, 0))
    for seed in (1, 2):
        found = kernels.new(lambda: learn(scene, ours, seed))  # noqa: B023
        # Those that copy a table hang on where NumPy has it.
        assert [kernel["operation_count"] for kernel in found if kernel["operation_count"] >= LARGE] == []
