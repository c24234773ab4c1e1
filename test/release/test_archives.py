"""Archives of a release: what must not be inside is named, what is missing too, and equal contents give equal bytes."""

from __future__ import annotations

import io
import tarfile
import zipfile
from pathlib import Path

from release.archives import OF_THE_SOURCES, OF_THE_WHEEL, complaints, names_in, same_each_time


def wheel(path: Path, *names: str) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name in names:
            archive.writestr(name, "")
    return path


def sources(path: Path, names: list[str], **about: int) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name in names:
            member = tarfile.TarInfo(f"agv_ncs-1/{name}")
            member.size = len(name)
            for key, value in about.items():
                setattr(member, key, value)
            archive.addfile(member, io.BytesIO(name.encode()))
    return path


def test_what_does_not_belong_or_is_missing_is_named(tmp_path: Path) -> None:
    whole = wheel(tmp_path / "whole.whl", *OF_THE_WHEEL)
    assert complaints(whole) == []
    wrong = wheel(tmp_path / "wrong.whl", *OF_THE_WHEEL[1:], "test/conftest.py", "agv_ncs/lap.mcap")
    assert complaints(wrong) == [
        "wrong.whl: agv_ncs/lap.mcap must not be inside",
        "wrong.whl: test/conftest.py must not be inside",
        f"wrong.whl: {OF_THE_WHEEL[0]} is missing",
    ]


def test_the_same_sources_give_the_same_bytes(tmp_path: Path) -> None:
    names = list(OF_THE_SOURCES)
    one = sources(tmp_path / "one.tar.gz", names, mtime=1, uid=1000)
    other = sources(tmp_path / "other.tar.gz", names[::-1], mtime=2, uid=0)
    assert complaints(one) == []
    before = names_in(one)
    for archive in (one, other):
        same_each_time(archive, 1_700_000_000)
    assert one.read_bytes() == other.read_bytes()
    assert names_in(one) == before == sorted(names)
    with tarfile.open(one) as opened:
        member = opened.getmember("agv_ncs-1/setup.py")
        file = opened.extractfile(member)
        assert file is not None
        assert (member.mtime, member.uid, file.read()) == (1_700_000_000, 0, b"setup.py")
