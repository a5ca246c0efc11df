"""A file of measurements that is current while they are made: whole at every moment, however the process ends."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from reslrb_cli.records.atomic import remove_parts_of, write_atomically
from reslrb_cli.records.lines import Line


class LineFile:
    """JSON with one object a line, written anew as a whole each time; what another process wrote stays until then.

    A pipe, or whatever else is no regular file, has each line once: those that are final, as they come.
    """

    def __init__(self, path: Path) -> None:
        # What a link points to is replaced, not the link.
        self._path = Path(os.path.realpath(path))
        self.is_stream = os.path.lexists(path) and not self._path.is_file()
        self._stream: IO[str] | None = None
        self._sent: set[str] = set()
        if not self.is_stream:
            remove_parts_of(self._path)

    def write(self, final: Sequence[Line], provisional: Sequence[Line] = ()) -> None:
        """Write all lines so far: those that are final, which a later call has too, and the others.

        Raises OSError, and then the file is as it was.
        """
        if not self.is_stream:
            text = "".join(line.to_json() + "\n" for line in [*final, *provisional])
            write_atomically(self._path, lambda file: file.write(text.encode()))
            return
        if self._stream is None:
            self._stream = self._path.open("w", encoding="utf-8")
        for text in [line.to_json() for line in final]:
            if text not in self._sent:
                self._sent.add(text)
                self._stream.write(text + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Close what is open."""
        if self._stream is not None:
            self._stream.close()
