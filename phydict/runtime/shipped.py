"""What comes with the project: priors, tables, configurations and an example.

They lie in the folders data and configs, in a checkout beside the package, in an installed one inside it; their names
are those in a checkout, such as data/prior/phydict_64.safetensors.
"""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def shipped(name: str | Path) -> Path:
    """The place of a file or folder that comes with the project."""
    inside = PACKAGE / name
    return inside if inside.exists() else PACKAGE.parent / name


def own_or_shipped(path: str | Path) -> Path:
    """`path` where there is such a file or folder, or nothing shipped has that name; else the shipped one."""
    path = Path(path)
    comes_with = not path.is_absolute() and path.parts[:1] in (("data",), ("configs",)) and ".." not in path.parts
    return shipped(path) if comes_with and not path.exists() and shipped(path).exists() else path


def configuration(given: str | Path, kinds: tuple[str, ...]) -> Path:
    """The configuration file `given`: one that is there, or a shipped one by its path or, if it is of one of `kinds`
    (the folders of configs), by its name: phydict_fast.

    Raises ValueError, listing the names of these kinds, where there is none.
    """
    if own_or_shipped(given).is_file():
        return own_or_shipped(given)
    files = {file.stem: file for kind in kinds for file in sorted(shipped(f"configs/{kind}").glob("*.yaml"))}
    if str(given).removesuffix(".yaml") not in files:
        raise ValueError(f"there is no configuration {given or repr('')}: give a YAML file, or the name of one that "
                         f"comes with the project ({', '.join(files)})")
    return files[str(given).removesuffix(".yaml")]
