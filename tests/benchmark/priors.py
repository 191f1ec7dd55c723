"""What the prior is worth: the default with several priors beside the best methods without one, ideal and polychromatic
X-rays from 1 to 16 views.

    python tests/benchmark/priors.py <folder of CTs> <name>=<prior file> ...

Polychromatic X-rays are made on 128^3 voxels and reconstructed on 64^3. Writes priors/ beside this file as `infer.py
ablate` does, and goes on where it was stopped.
"""

import sys
import tempfile
from pathlib import Path

import yaml

from phydict.ablation.command import main

if __name__ == "__main__":
    if len(sys.argv) < 3 or not all("=" in given for given in sys.argv[2:]):
        raise SystemExit("give a folder of CTs and priors: python tests/benchmark/priors.py <folder> <name>=<file> ...")
    cts, *given = sys.argv[1:]
    priors = {f"phydict_fast, {name}": file for name, _, file in (prior.partition("=") for prior in given)}
    axes = {"views": [1, 2, 4, 8, 16], "method": [*priors, "tv", "sirt"]}
    comparison = {"methods": {name: {"of": "phydict_fast", "prior": file} for name, file in priors.items()},
                  "products": [{"axes": axes},
                               {"base": {"simulator": "polychromatic", "simulation_voxels": 128}, "axes": axes}]}
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        yaml.safe_dump(comparison, file)
        file.flush()
        main(["-c", file.name, "--cts", cts, "--out", str(Path(__file__).with_suffix(""))])
