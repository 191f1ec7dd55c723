"""The modules of the package, the parts of the house that they belong to, and where Lightning lives."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "phydict"
LIGHTNING = ("training", "inference", "ablation", "cli")
"""The parts that may import Lightning."""


def files() -> list[Path]:
    return sorted(f for f in PACKAGE.rglob("*.py") if f != PACKAGE / "__init__.py")


def part(file: Path) -> str:
    """The part of the house that a file belongs to: a folder or a module of the package's top."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def module_of(file: Path) -> str:
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
