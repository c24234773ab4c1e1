"""`make dist`: build source archive and wheel twice from what is committed, check both, install the wheel, try it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from release.archives import complaints, names_in, same_each_time

REPOSITORY = Path(__file__).parents[1]
OUT = REPOSITORY / "dist"

TRIED = (
    ("--version",),
    ("doctor", "--seconds", "0.2"),
    ("simulate", "{share}/config/outages.yaml", "--set", "plant.duration=5.0"),
    ("stability", "{share}/config/paper.yaml"),
)
"""Commands that must work where nothing but the wheel is installed."""


def build(into: Path, epoch: int) -> list[Path]:
    """Both archives of the newest commit, the wheel built from the source archive."""
    into.mkdir()
    with tempfile.TemporaryDirectory() as folder:
        exported = subprocess.run(["git", "archive", "HEAD"], cwd=REPOSITORY, stdout=subprocess.PIPE, check=True).stdout
        subprocess.run(["tar", "-x", "-C", folder], input=exported, check=True)
        environment = {**os.environ, "SOURCE_DATE_EPOCH": str(epoch), "PYTHONHASHSEED": "0"}
        command = [sys.executable, "-m", "build", "--outdir", str(into), folder]
        subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, check=True, umask=0o022)
    (sources,) = into.glob("*.tar.gz")
    same_each_time(sources, epoch)
    return sorted(into.iterdir())


def try_wheel(wheel: Path) -> None:
    """Install the wheel in a fresh environment and run commands of it, far from the sources."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        binaries = Path(folder) / "bin"
        install = [
            str(binaries / "python"),
            "-m",
            "pip",
            "install",
            "--quiet",
            "--disable-pip-version-check",
            str(wheel),
        ]
        subprocess.run(install, cwd=folder, check=True)
        for arguments in TRIED:
            words = [word.replace("{share}", f"{folder}/share/agv_ncs") for word in arguments]
            subprocess.run([binaries / "agv-ncs", *words], cwd=folder, stdout=subprocess.DEVNULL, check=True)
            sys.stdout.write(f"tried: agv-ncs {' '.join(words)}\n")


def main() -> None:
    """Leave both archives in dist/, or end with status 1."""
    command = ["git", "log", "-1", "--format=%ct"]
    epoch = int(subprocess.run(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True, check=True).stdout)
    shutil.rmtree(OUT, ignore_errors=True)
    archives = build(OUT, epoch)
    with tempfile.TemporaryDirectory() as folder:
        again = build(Path(folder) / "again", epoch)
        wrong = [f"{one.name}: two builds differ" for one, other in zip(archives, again, strict=True)
                 if one.read_bytes() != other.read_bytes()]  # fmt: skip
    wrong += [line for archive in archives for line in complaints(archive)]
    if wrong:
        raise SystemExit("\n".join(wrong))
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *archives], check=True)
    for archive in archives:
        sys.stdout.write(f"{archive.relative_to(REPOSITORY)}: {len(names_in(archive))} files, the same in two builds\n")
    try_wheel(next(archive for archive in archives if archive.suffix == ".whl"))


if __name__ == "__main__":
    main()
