"""The choice of the variant: CUDA where a ray can be traced on it, LLVM elsewhere, and a reason where neither."""

from __future__ import annotations

import logging
import subprocess
import sys

import pytest

from reslrb_cli.backend import probe as probe_module
from reslrb_cli.backend import variant
from reslrb_cli.backend.probe import Probe, probe
from reslrb_cli.errors import BackendError, ExitCode


def test_auto_takes_cuda_where_it_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variant, "missing_cuda", lambda _name: "")
    assert variant.choose("auto") == ("cuda_ad_rgb", "")
    monkeypatch.setattr(variant, "missing_cuda", lambda _name: "no OptiX")
    assert variant.choose("auto") == ("llvm_ad_rgb", "; no CUDA: no OptiX")


def test_a_driver_is_not_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variant.ctypes, "CDLL", lambda _name: None)
    monkeypatch.setattr(variant, "probe", lambda _name: Probe("jit_optix_api_init(): could not be loaded"))
    assert "optix" in variant.missing_cuda()


def test_cuda_without_a_driver_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent/libcuda.so.1")
    with pytest.raises(BackendError, match="no NVIDIA driver") as refused:
        variant.set_variant("cuda_ad_rgb")
    assert refused.value.exit_code is ExitCode.BACKEND


def test_set_variant_logs_its_choice(llvm: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        assert variant.set_variant("llvm_ad_rgb") == "llvm_ad_rgb"
    assert "variant llvm_ad_rgb (libLLVM " in caplog.text


def test_the_trial_compiles_and_traces(llvm: str) -> None:
    result = probe("llvm_ad_rgb")
    assert result.failure == ""
    assert result.compile_ms is not None
    assert result.ray_ms is not None


@pytest.mark.parametrize(
    ("script", "failure"),
    [
        ("raise RuntimeError('no such device')", "RuntimeError: no such device"),
        ("import os, sys; print('LLVM ERROR: x', file=sys.stderr, flush=True); os.abort()", "signal 6: LLVM ERROR: x"),
        ("raise ImportError('libatomic.so.1: cannot open shared object file: ...')", "needs libatomic.so.1"),
        ("raise SystemExit(3)", "ended with code 3"),
    ],
)
def test_a_trial_that_fails_is_told_in_a_line(monkeypatch: pytest.MonkeyPatch, script: str, failure: str) -> None:
    monkeypatch.setattr(probe_module, "_SCRIPT", script)
    assert failure in probe.__wrapped__("llvm_ad_rgb").failure


def test_an_old_libllvm_taken_by_dr_jit_itself_is_refused(llvm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import drjit as dr

    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (15, 0, 6))
    with pytest.raises(BackendError, match="took libLLVM 15"):
        variant.set_variant("llvm_ad_rgb")


def test_an_unknown_variant_is_refused(llvm: str) -> None:
    with pytest.raises(BackendError, match="has no variant llvm_ad_taste"):
        variant.set_variant("llvm_ad_taste")


def test_broken_mitsuba_is_told_in_a_line(llvm: str) -> None:
    script = (
        "import sys; sys.modules['drjit'] = None\n"
        "from reslrb_cli.backend.variant import set_variant; set_variant('llvm_ad_rgb')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "BackendError: Mitsuba cannot be loaded" in done.stderr.splitlines()[-1]
