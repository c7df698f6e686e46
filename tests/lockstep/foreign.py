"""The examples' package beside ours, as an installer leaves it: its modules, and a dist-info of its pyproject.toml.

No installer runs, since what builds a wheel need not be there, nor a network to fetch it.
"""

import shutil
import tomllib
from pathlib import Path

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "starling-springs"


def install(source: Path, site: Path) -> Path:
    """Install a package from its folder into the folder `site`, which is to be put on the path; returns it."""
    project = tomllib.loads((source / "pyproject.toml").read_text())
    name, version = project["project"]["name"], project["project"]["version"]
    for package in project["tool"]["setuptools"]["packages"]:
        shutil.copytree(source / package, site / package, ignore=shutil.ignore_patterns("__pycache__"))
    information = site / f"{name.replace('-', '_')}-{version}.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    groups = project["project"]["entry-points"]
    lines = [line for g, points in groups.items() for line in (f"[{g}]", *(f"{k} = {v}" for k, v in points.items()))]
    (information / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return site
