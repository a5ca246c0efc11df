"""Every parameter has files of its own, whatever its key is."""

from __future__ import annotations

import pytest

from reslrb_cli.records.images import MOST_BYTES, file_stem


@pytest.mark.parametrize("key", ["wall.reflectance.data", "Sphere_3.emitter.radiance.value", "Wände.alpha-2"])
def test_what_can_be_a_name_is_one(key: str) -> None:
    assert file_stem(key) == key


def test_keys_that_look_alike_have_names_of_their_own() -> None:
    long = "a" * 300
    keys = ["a b", "a_b", "a/b", "a__b", "a  b", "a\x1bb", long, long + "b", f"{long} b", f"{long}_b", "é" * 200 + "/"]
    names = [file_stem(key) for key in keys]
    assert len(set(names)) == len(keys)
    assert all(len(name.encode()) <= MOST_BYTES and "/" not in name and name.isprintable() for name in names)
    assert file_stem("a_b") == "a_b"
    assert file_stem("a b").startswith("a_b-")
    assert file_stem("a b") == file_stem("a b")
