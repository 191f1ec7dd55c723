"""What the prior is worth: the default with several priors beside the best methods without one, ideal and polychromatic
X-rays from 1 to 16 views.

    python tests/benchmark/priors.py <folder of CTs> <name>=<prior file> ... [--out folder]

Polychromatic X-rays are made on 128^3 voxels and reconstructed on 64^3. From four views two more methods without a
prior are measured. Writes what `infer.py ablate` does, by default into priors/ beside this file, and resumes where it
was stopped.
"""

import argparse
import tempfile
from pathlib import Path

import yaml

from phydict.ablation.command import main

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", help="folder of CTs")
    parser.add_argument("priors", nargs="+", metavar="name=file")
    parser.add_argument("--out", default=str(Path(__file__).with_suffix("")))
    given = parser.parse_args()
    if not all("=" in prior for prior in given.priors):
        parser.error("a prior is given as <name>=<file>")
    priors = {f"phydict_fast, {name}": file for name, _, file in (prior.partition("=") for prior in given.priors)}
    axes = {"views": [1, 2, 4, 8, 16], "method": [*priors, "tv", "sirt"]}
    more = {"views": [4], "method": ["cgls", "diffvox"]}
    polychromatic = {"simulator": "polychromatic", "simulation_voxels": 128}
    comparison = {"methods": {name: {"of": "phydict_fast", "prior": file} for name, file in priors.items()},
                  "products": [{"base": base, "axes": each} for base in ({}, polychromatic) for each in (axes, more)]}
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        yaml.safe_dump(comparison, file)
        file.flush()
        main(["-c", file.name, "--cts", given.cts, "--out", given.out])
