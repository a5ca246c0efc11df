"""How the samples of a step are split into passes, and what is too many of them; known before a scene is loaded."""

from __future__ import annotations

from .limits import PASS_PATHS, PASS_SAMPLES, PASSES


def passes_obstacle(spp: int, per_pass: int | None, pixels: int, splits: bool = True) -> str | None:
    """Why `spp` samples per pixel of a film of so many `pixels` cannot be traced, and what would be right; or None.

    `per_pass` is the integrator's `samples_per_pass`; it divides `spp`, or is larger. An integrator that does not
    split its samples by itself (`splits`) has none.
    """
    unit = min(per_pass or spp, spp)
    parts = -(-unit // PASS_SAMPLES) if splits else 1
    paths = -(-unit // parts) * pixels
    most = largest_pass(spp, pixels)
    if paths > PASS_PATHS:
        advice = f"set integrator.samples_per_pass to {most}, or lower run.spp" if splits and most else "lower run.spp"
        advice = advice if PASS_PATHS >= pixels else "take a smaller film"
        return f"makes {paths} light paths in one pass, and no pass has more than {PASS_PATHS}: {advice}"
    if spp // unit * parts > PASSES:
        advice = f"set integrator.samples_per_pass to {most}" if most and spp // most <= PASSES else "lower run.spp"
        return f"makes {spp // unit * parts} passes of a step, and no step has more than {PASSES}: {advice}"
    return None


def largest_pass(spp: int, pixels: int) -> int | None:
    """The largest `samples_per_pass` that divides `spp` and makes no more paths than a pass can have; None without."""
    most = min(PASS_PATHS // pixels, PASS_SAMPLES, spp)
    return max((n for n in divisors(spp) if n <= most), default=None)


def divisors(number: int) -> list[int]:
    """All divisors of a number, the smallest first; of one of 31 bits at once."""
    small = [n for n in range(1, int(number**0.5) + 1) if number % n == 0]
    return sorted({*small, *(number // n for n in small)})
