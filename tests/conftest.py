"""Each of several test processes computes on one thread: two on two cores would slow each other down."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:  # before torch and numba are imported
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")

from collections.abc import Iterator
from pathlib import Path

import nibabel
import numpy as np
import pytest
from command_lines import arguments


@pytest.fixture
def without_plots(monkeypatch):
    """Has ablations draw no plots, which take longer than most methods in tests."""
    monkeypatch.setattr("phydict.ablation.command.write_plots", lambda *_: [])


@pytest.fixture(scope="session")
def phantoms_made_once() -> Iterator[None]:
    """Has infer.py's commands make each phantom once; that it would be the same again is a law of tests/datasets."""
    from phydict.inference import data  # which takes seconds to import

    made, make = {}, data.phantom_case

    def kept(seed, grid, window):
        key = seed, grid.shape, grid.affine.tobytes(), window
        if key not in made:
            made[key] = make(seed, grid, window)
        return {name: value.clone() if hasattr(value, "clone") else value for name, value in made[key].items()}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(data, "phantom_case", kept)
        yield


@pytest.fixture(scope="session")
def cache(tmp_path_factory) -> Path:
    """A folder for the prepared cases of trainings."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def trained(tmp_path_factory, cache) -> Path:
    """The folder of an uninterrupted run of two epochs."""
    from phydict.cli.train import main  # which takes seconds to import

    folder = tmp_path_factory.mktemp("trained")
    main(arguments(folder, cache, "--trainer.max_epochs=2"))
    return folder


@pytest.fixture(scope="session")
def refiner_file(tmp_path_factory) -> str:
    """The file of a tiny refiner."""
    import torch  # these take seconds to import
    from prior.tiny import tiny_refiner

    from phydict.prior import save_refiner

    file = tmp_path_factory.mktemp("refiner") / "tiny.safetensors"
    save_refiner(tiny_refiner(), file, dtype=torch.float32)
    return str(file)


@pytest.fixture(scope="session")
def cts(tmp_path_factory) -> Path:
    """A folder of two small CTs."""
    folder = tmp_path_factory.mktemp("cts")
    for n in range(2):
        hu = np.full((20, 20, 20), -1000, np.int16)
        hu[4:16, 6:15, :] = 40 + n
        image = nibabel.Nifti1Image(hu, np.diag([10.0, 10.0, 10.0, 1.0]))
        image.set_sform(image.affine, code=1)
        nibabel.save(image, folder / f"patient{n}.nii.gz")
    return folder
