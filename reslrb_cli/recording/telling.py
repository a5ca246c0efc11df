"""What an error comes to: the one line that a user sees, and the exit code."""

from __future__ import annotations

from reslrb_cli.errors import LINE_LENGTH, ExitCode, ReslrbError, is_machine_fault, is_out_of_memory, one_line

#: Characters that are shown of what a library says.
QUOTED_LENGTH = 200


def tell(error: BaseException) -> tuple[str, int] | None:
    """The line and the exit code for `error`; None for a fault of ours, whose traceback is wanted."""
    if isinstance(error, ReslrbError):
        return str(error), error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", ExitCode.INTERRUPTED
    if is_out_of_memory(error):
        advice = "lower run.spp or the size of the film, or set run.memory_budget or integrator.samples_per_pass"
        return f"out of memory ({one_line(error, QUOTED_LENGTH) or 'host'}); {advice}", ExitCode.OUT_OF_MEMORY
    if isinstance(error, OSError) and (error.filename is not None or is_machine_fault(error)):
        code = ExitCode.MACHINE if is_machine_fault(error) else ExitCode.USAGE
        return ": ".join(str(part) for part in (error.filename, error.strerror) if part is not None), code
    if is_machine_fault(error):
        return f"the driver or its compiler failed: {one_line(error, QUOTED_LENGTH)}", ExitCode.MACHINE
    return None


def describe(error: BaseException) -> str:
    """One printable line for `error`, whatever it is."""
    told = tell(error)
    if told is None:
        return f"{type(error).__name__}: {one_line(error, QUOTED_LENGTH)}".rstrip(": ")
    return one_line(told[0], LINE_LENGTH)
