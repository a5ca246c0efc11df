#!/usr/bin/env python3
"""Writes docs/paper.md, figure by figure what is published beside what is ours, from the records in docs/paper/.

    scripts/paper write [FOLDER]

takes over figure1.json, figure5.json, figure6.jsonl and their pictures from FOLDER first. No figure of ours is typed.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import paper_page
from paper_page import RECORDS

IMAGES, PAGE = paper_page.ROOT / "docs" / "images", paper_page.ROOT / "docs" / "paper.md"
#: What is taken over.
NAMES = {f"{name}.{ending}" for name, ending in (("figure1", "json"), ("figure5", "json"), ("figure6", "jsonl"))}
NAMES |= {f"figure{number}.png" for number in (1, 5, 6)}


def main(arguments: list[str]) -> int:
    """Take over what was recorded, and write the page; the exit code."""
    if len(arguments) > 1 or any(word.startswith("-") for word in arguments):
        print("usage: scripts/paper write [FOLDER]", file=sys.stderr)
        return 0 if arguments in (["-h"], ["--help"]) else 2
    for folder in map(Path, arguments):
        found = [file for file in sorted(folder.glob("figure*")) if file.name in NAMES]
        if not found:
            print(f"paper: {folder} holds no figure1.json, figure5.json or figure6.jsonl", file=sys.stderr)
            return 2
        for file in found:
            shutil.copy(file, IMAGES if file.suffix == ".png" else RECORDS)
    PAGE.write_text(paper_page.page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
